"""The take store: one Zarr v3 group per take, written once and never appended to, in a folder or an object store.

Chunks hold a few frames, so that a window can be read alone; shards hold up to sixty, so that a take is a few dozen
files. Writing is atomic: a take is there as a whole or not at all (:mod:`quest.data.store_location` says how).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from quest.data.frame_source import FrameSource, Reader, ReadOptions, source_of_clip
from quest.data.store_location import SUFFIX, LocalFolder, Location, StoreError, open_location
from quest.data.take_format import (
    HEADER_FILE,
    REMEDY,
    TAKE_ARRAYS,
    VIEW_ARRAYS,
    TakeHash,
    TakeHeader,
    check_take,
    decode_depth,
    hash_take,
    parse_header,
    take_arrays,
)
from quest.errors import TakeError
from quest.types import Clip, Take, TakeInfo, View
from quest.untrusted import is_name, reading
from quest.wording import counted

if TYPE_CHECKING:
    import zarr

FRAMES_PER_CHUNK = 4
FRAMES_PER_SHARD = 60
PIXEL_ARRAYS = ("rgb", "depth", "link_id", "entity_id")
_MOST_PACKED = 2**16
"""Bytes of an array per byte in its files: zstd packs equal bytes 2^15 times."""
_NAMED = 8
"""Takes of a store that a message names."""


class TakeStore:
    """Takes in a folder or an object store, one ``<name>.zarr`` group each.

    Args:
        root: the folder, made by the first :meth:`write`; or a URL such as ``s3://bucket/takes``, as a string.

    Raises:
        ConfigError: it is a URL that cannot be used.
        MissingExtraError: it is in an object store and the extra ``scale`` is not installed.
    """

    def __init__(self, root: str | Path) -> None:
        self._location: Location = open_location(root)

    def __repr__(self) -> str:
        return f"TakeStore({self.url!r})"

    def __len__(self) -> int:
        return len(self.names())

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and isinstance(self._try_header(name), TakeHeader)

    @property
    def url(self) -> str:
        """The folder or URL, as it was given."""
        return self._location.url

    @property
    def root(self) -> Path:
        """The folder; see :attr:`is_folder`.

        Raises:
            TakeError: the takes are in an object store.
        """
        return self._folder().folder

    @property
    def is_folder(self) -> bool:
        """Whether the takes are in a folder, and not in an object store."""
        return isinstance(self._location, LocalFolder)

    def exists(self) -> bool:
        """Whether the folder exists, or the object store has any take under the URL."""
        return self._location.exists()

    def names(self) -> list[str]:
        """Names of the whole takes, sorted; empty if the folder does not exist. See :meth:`problems` for the others."""
        return list(self.headers())

    def problems(self) -> dict[str, str]:
        """What is wrong with each group that looks like a take but cannot be read, by name."""
        found = self._headers(self._location.names())
        return {name: str(error) for name, error in found if isinstance(error, TakeError)}

    def infos(self) -> dict[str, TakeInfo]:
        """Descriptions of all whole takes by name; reads no pixels."""
        return {name: header.info for name, header in self.headers().items()}

    def headers(self, names: Iterable[str] | None = None) -> dict[str, TakeHeader]:
        """Headers (description, number of frames, cameras, hash) of whole takes by name; reads no pixels.

        Args:
            names: those of these names that are there as a whole; all by default.
        """
        found = self._headers(self._location.names() if names is None else names)
        return {name: header for name, header in found if isinstance(header, TakeHeader)}

    def header(self, name: str) -> TakeHeader:
        """Description, number of frames, cameras and hash of one take; reads no pixels.

        Raises:
            TakeError: the take is missing, torn, or of another format version.
        """
        _check_name(name)
        where, data = self._location.describe(name), self._location.header(name)
        if data is None and not self._location.is_there(name):
            raise TakeError(f"take {name!r}: no folder {where}; check the name, or generate the take")
        header = parse_header(name, where, data)
        there = self._location.sizes(name, header.files)
        for path, size in header.files.items():
            if there.get(path) != size:
                found = f"has {there[path]} bytes, expected {size}" if path in there else "is missing"
                raise TakeError(f"take {name!r} is torn: {where}/{path} {found}; {REMEDY}")
        return header

    def path(self, name: str) -> Path:
        """Folder of a take, there or not.

        Raises:
            TakeError: the name cannot be one, or the takes are in an object store.
        """
        _check_name(name)
        return self._folder().path(name)

    def data_hash(self, name: str) -> str:
        """SHA-256 over the take's arrays and its description without provenance, as recorded when it was written."""
        return self.header(name).data_hash

    def read(self, name: str, *, views: Sequence[int] | None = None, frames: slice | None = None) -> Take:
        """A take, or only some of its views and frames.

        Args:
            name: the take.
            views: indices of the views to read; all by default, none for an empty sequence.
            frames: the frames to read; all by default. The motion of entities counts from the first one read. With a
                step, flow is that between the frames read, 0 at the last, and the frame rate is divided by it; the flow
                of the last of consecutive frames leads to the next one in the store.

        Raises:
            TakeError: the take is missing, torn or of another format version, or has no such view or frame.
        """
        with self._opened(name, frames) as stored:
            arrays = {key: stored.read(key).astype(dtype, copy=False) for key, dtype in TAKE_ARRAYS.items()}
            chosen = range(len(stored.header.cameras)) if views is None else views
            parts = tuple(stored.view(view) for view in chosen)
        info, step = stored.header.info, stored.rows.step
        if step > 1:
            point = arrays["point_world"]
            arrays["flow_world"] = np.diff(point, axis=0, append=point[-1:])
            info = replace(info, frames_per_s=info.frames_per_s / step)
        return Take(info=info, views=parts, **arrays)

    def read_view(self, name: str, view: int, *, frames: slice | None = None) -> View:
        """One camera's frames of a take with their ground truth, loading nothing else.

        Raises:
            TakeError: as :meth:`read`.
        """
        with self._opened(name, frames) as stored:
            return stored.view(view)

    def read_clip(self, name: str, view: int = 0, *, frames: slice | None = None) -> Clip:
        """One camera's frames of a take without any ground truth, loading nothing else.

        Raises:
            TakeError: as :meth:`read`.
        """
        with self._opened(name, frames) as stored:
            return stored.clip(view)

    def read_small_arrays(self, name: str) -> dict[str, np.ndarray]:
        """Every array of a take but its pixels, by path in the group, such as ``view_0/visible``.

        Raises:
            TakeError: the take is missing, torn or of another format version.
        """
        small = [key for key in ("cam_from_world", *VIEW_ARRAYS) if key not in PIXEL_ARRAYS]
        with self._opened(name) as stored:
            views = range(len(stored.header.cameras))
            return {
                path: stored.read(path) for path in [*TAKE_ARRAYS, *(f"view_{v}/{k}" for v in views for k in small)]
            }

    def verify(self, name: str) -> None:
        """Read every array of a take and compare with its recorded hash.

        Raises:
            TakeError: a file was altered since the take was written.
        """
        take = self.read(name)
        recorded = self.data_hash(name)
        found = hash_take(take)
        if found != recorded:
            raise TakeError(
                f"take {name!r}: its arrays have hash {found[:12]}, recorded is {recorded[:12]}; a file was altered, "
                "delete its folder and generate it again"
            )

    def write(self, take: Take) -> None:
        """Write a take, all or nothing: a killed process leaves no part of it in the store.

        Depth is kept to 0.1 mm up to 6.55 m, and missing beyond; all else is lossless.

        Raises:
            InputError: arrays of the take contradict each other.
            TakeError: the store has a take of that name.
        """
        check_take(take)
        name = take.info.name
        _check_name(name)
        if not self._location.may_write(name):
            raise TakeError(
                f"take {name!r}: {self._location.describe(name)} exists and takes are written once; delete it or "
                "choose another name"
            )
        self._location.write(name, lambda arrays_at: _take_files(take, arrays_at))

    def _folder(self) -> LocalFolder:
        if not isinstance(self._location, LocalFolder):
            raise TakeError(f"store {self.url}: expected a folder of takes, and this is an object store")
        return self._location

    def _headers(self, names: Iterable[str]) -> list[tuple[str, TakeHeader | TakeError]]:
        chosen = list(names)
        if self._location.parallel == 1 or len(chosen) < 2:
            return [(name, self._try_header(name)) for name in chosen]
        with ThreadPoolExecutor(self._location.parallel) as pool:
            return list(zip(chosen, pool.map(self._try_header, chosen), strict=True))

    def _try_header(self, name: str) -> TakeHeader | TakeError:
        try:
            return self.header(name)
        except StoreError:
            raise
        except TakeError as error:
            return error

    @contextmanager
    def _opened(self, name: str, frames: slice | None = None) -> Iterator[_Stored]:
        """The open group; damage that only decoding shows becomes a TakeError."""
        import zarr

        header = self.header(name)
        rows = slice(None) if frames is None else frames
        picked = range(header.frames)[rows]
        if len(picked) == 0 or picked.step < 1:
            raise TakeError(
                f"take {name!r}: {rows} picks no frame, or runs backwards; it has frames 0 to {header.frames - 1}"
            )
        where = self._location.describe(name)
        with reading(f"take {name!r}: {where} is torn: an array", TakeError, REMEDY), self._location.reaching():
            store, path = self._location.zarr_group(name, header.arrays_at)
            group = zarr.open_group(store, path=path, mode="r", zarr_format=3, use_consolidated=False)
            yield _Stored(group, header, slice(picked.start, picked.stop, picked.step))


def locate_take(path: str | Path) -> tuple[TakeStore, str]:
    """Store and name of the take that a folder or URL (``STORE/NAME.zarr``) names, there or not.

    Raises:
        TakeError: it does not end like the folder of a take.
    """
    parent, _, last = str(path).replace("\\", "/").rstrip("/").rpartition("/")
    if not last.endswith(SUFFIX):
        raise TakeError(f"take {last!r}: expected a folder <name>{SUFFIX}, got {path}")
    if isinstance(path, Path) or "://" not in parent:
        return TakeStore(Path(path).parent), last.removesuffix(SUFFIX)
    return TakeStore(parent), last.removesuffix(SUFFIX)


def open_clip(path: str | Path, *, view: int = 0, frames: slice | None = None) -> Clip:
    """The clip of one view of a take, by the take's folder or URL (``store/take.zarr``).

    Raises:
        TakeError: the take is missing, torn or of another format version, or has no such view or frame.
    """
    store, name = locate_take(path)
    return store.read_clip(name, view, frames=frames)


def _check_name(name: str) -> None:
    if not is_name(name):
        raise TakeError(f"take {name!r}: a name must not be empty or long, start with a dot or contain a slash")


@dataclass(frozen=True)
class _Stored:
    """Some frames of an open take."""

    group: zarr.Group
    header: TakeHeader
    rows: slice

    def read(self, path: str) -> np.ndarray:
        """The frames of an array; nothing is allocated that its files cannot hold."""
        array: Any = self.group[path]
        files = f"{self.header.arrays_at}/{path}/".removeprefix("/")
        stored = sum(size for file, size in self.header.files.items() if file.startswith(files))
        if array.shape[:1] != (self.header.frames,) or array.nbytes > _MOST_PACKED * stored:
            raise TakeError(
                f"take {self.header.info.name!r}: {path} has shape {array.shape} for {self.header.frames} frames in "
                f"{stored} bytes; {REMEDY}"
            )
        return np.asarray(array[self.rows])

    @cached_property
    def stamp_s(self) -> np.ndarray:
        return self.read("stamp_s")

    def clip(self, view: int) -> Clip:
        header = self.header
        if not 0 <= view < len(header.cameras):
            raise TakeError(f"take {header.info.name!r}: no view {view}; it has views 0 to {len(header.cameras) - 1}")
        return Clip(
            name=header.clip_names[view],
            camera=header.cameras[view],
            rgb=self.read(f"view_{view}/rgb"),
            depth_m=decode_depth(self.read(f"view_{view}/depth")) if header.has_depth[view] else None,
            stamp_s=self.stamp_s,
            cam_from_world=self.read(f"view_{view}/cam_from_world"),
        )

    def view(self, view: int) -> View:
        return View(clip=self.clip(view), **{key: self.read(f"view_{view}/{key}") for key in VIEW_ARRAYS})


def _take_files(take: Take, arrays_at: str) -> Iterator[tuple[str, bytes | memoryview]]:
    """All files of a take, the header last."""
    cameras = tuple(view.clip.camera for view in take.views)
    digest = TakeHash(take.info, cameras)
    files: dict[str, int] = {}
    for path, array in take_arrays(take):
        digest.add(path, array)
        for file, data in _encode_array(path, array):
            place = f"{arrays_at}/{file}" if arrays_at else file
            if place != HEADER_FILE and place not in files:  # every array brings the groups that it lies in
                files[place] = len(data)
                yield place, data
    header = TakeHeader(
        info=take.info,
        frames=len(take),
        cameras=cameras,
        clip_names=tuple(view.clip.name for view in take.views),
        has_depth=tuple(view.clip.depth_m is not None for view in take.views),
        data_hash=digest.hexdigest(),
        files=dict(sorted(files.items())),
        arrays_at=arrays_at,
    )
    yield HEADER_FILE, header.to_json()


def _encode_array(path: str, array: np.ndarray) -> Iterator[tuple[str, memoryview]]:
    """Files of an array by path in the group, a shard at a time."""
    import zarr
    from zarr.codecs import BloscCodec, Crc32cCodec
    from zarr.storage import MemoryStore

    frames = len(array)
    shard = frames
    options: dict[str, Any] = {"chunks": array.shape}
    if path.rpartition("/")[2] in PIXEL_ARRAYS:
        chunk = min(FRAMES_PER_CHUNK, frames)
        shard = min(FRAMES_PER_SHARD // chunk, -(-frames // chunk)) * chunk
        options = {"chunks": (chunk, *array.shape[1:]), "shards": (shard, *array.shape[1:])}
    options["chunks"] = tuple(max(1, n) for n in options["chunks"])  # a take without joints has empty arrays
    compressor = BloscCodec(cname="zstd", clevel=1, shuffle="shuffle", typesize=array.itemsize)
    files: dict[str, Any] = {}
    stored = zarr.create_array(
        MemoryStore(files),
        name=path,
        shape=array.shape,
        dtype=array.dtype,
        compressors=[compressor, Crc32cCodec()],
        # Empty chunks are written too, so that a chunk that is not there always means a torn take.
        config={"write_empty_chunks": True},
        **options,
    )
    for start in range(0, frames, shard):
        rows = slice(start, start + shard)
        stored[rows] = array[rows]
        for file in list(files):
            yield file, memoryview(files.pop(file).as_numpy_array())


def _accepts(where: str) -> bool:
    """Takes by their name, there or not; and stores of takes, to say which takes are in them."""
    return where.rstrip("/\\").endswith(SUFFIX) or "://" in where or any(Path(where).glob(f"*{SUFFIX}"))


def _open(where: str, options: ReadOptions) -> FrameSource:
    if where.rstrip("/\\").endswith(SUFFIX):
        return source_of_clip(open_clip(where, view=options.view))
    names = TakeStore(where).names()
    if not names:
        raise TakeError(f"store {where}: expected a take, and this store has none; generate takes into it")
    listed = ", ".join(names[:_NAMED]) + (f" and {len(names) - _NAMED} more" if len(names) > _NAMED else "")
    raise TakeError(
        f"store {where}: expected a take, and this is a store of {counted(len(names), 'take')} ({listed}); name one, "
        f"such as {where.rstrip('/')}/{names[0]}{SUFFIX}"
    )


READERS = (Reader("a take", "STORE/NAME.zarr", _accepts, _open, options=("view",)),)
