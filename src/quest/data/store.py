"""The take store: one Zarr v3 group per take, written once and never appended to, in a folder or an object store.

Chunks hold a few frames, so that a window can be read alone; shards hold up to sixty, so that a take is a few dozen
files. Writing is atomic: a take is there as a whole or not at all. In a folder it is made in a hidden folder beside the
others, and a rename makes it a take.

An object store is S3 and what speaks its protocol, Google Cloud Storage, Azure, or this process's memory. There is no
rename, so a take's header is its commit: it is put last, and only where there is none. Each writer puts its files under
a prefix of its own inside the take, so that writers of the same take never mix; the header names the prefix that
counts, and whoever puts the header removes what others left there.
"""

from __future__ import annotations

import os
import re
import shutil
import socket
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from datetime import timedelta
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit
from urllib.request import url2pathname

import numpy as np

from quest.data.frame_source import FrameSource, Reader, ReadOptions, source_of_clip
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
from quest.errors import ConfigError, TakeError
from quest.extras import require
from quest.types import Clip, Take, TakeInfo, View
from quest.untrusted import is_name, reading, require_file
from quest.wording import counted

if TYPE_CHECKING:
    import zarr
    from zarr.storage import StoreLike

SUFFIX = ".zarr"
SCHEMES = ("s3", "gs", "az", "memory", "s3a", "adl", "abfs", "abfss")
FRAMES_PER_CHUNK = 4
FRAMES_PER_SHARD = 60
PIXEL_ARRAYS = ("rgb", "depth", "link_id", "entity_id")
_MOST_PACKED = 2**16
"""Bytes of an array per byte in its files: zstd packs equal bytes 2^15 times."""
_NAMED = 8
"""Takes of a store that a message names."""
_TEMPORARY = ".tmp-"
_ABANDONED_AFTER_S = 24 * 3600.0
_SYNCS_AT_ONCE = 16
_PUTS_AT_ONCE = 8
_HEADERS_AT_ONCE = 16
_memories: dict[str, Any] = {}

_Files = Callable[[str], Iterator[tuple[str, bytes | memoryview]]]
"""Makes the files of a take, the header last, by their paths in it. The arrays go to a subgroup of some name, or with
none directly into the group."""


class StoreError(TakeError):
    """A place for takes that cannot be reached: this says nothing about any take."""


class TakeStore:
    """Takes in a folder or an object store, one ``<name>.zarr`` group each.

    Args:
        root: the folder, made by the first :meth:`write`; or a URL such as ``s3://bucket/takes``, as a string.

    Raises:
        ConfigError: it is a URL that cannot be used.
        MissingExtraError: it is in an object store and the extra ``scale`` is not installed.
    """

    def __init__(self, root: str | Path) -> None:
        self._place: _Folder | _Bucket = _open_place(root)

    def __repr__(self) -> str:
        return f"TakeStore({self.url!r})"

    def __len__(self) -> int:
        return len(self.names())

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and isinstance(self._try_header(name), TakeHeader)

    @property
    def url(self) -> str:
        """The folder or URL, as it was given."""
        return self._place.url

    @property
    def root(self) -> Path:
        """The folder; a TakeError if the takes are in an object store (:attr:`is_folder`)."""
        return self._as_folder().folder

    @property
    def is_folder(self) -> bool:
        """Whether the takes are in a folder, and not in an object store."""
        return isinstance(self._place, _Folder)

    def exists(self) -> bool:
        """Whether the folder exists, or the object store has any take under the URL."""
        return self._place.exists()

    def names(self) -> list[str]:
        """Names of the whole takes, sorted; empty if the folder does not exist. See :meth:`problems` for the others."""
        return list(self.headers())

    def problems(self) -> dict[str, str]:
        """What is wrong with each group that looks like a take but cannot be read, by name."""
        found = self._headers(self._place.names())
        return {name: str(error) for name, error in found if isinstance(error, TakeError)}

    def infos(self) -> dict[str, TakeInfo]:
        """Descriptions of all whole takes by name; reads no pixels."""
        return {name: header.info for name, header in self.headers().items()}

    def headers(self, names: Iterable[str] | None = None) -> dict[str, TakeHeader]:
        """Headers (description, number of frames, cameras, hash) of whole takes by name; reads no pixels.

        Args:
            names: those of these names that are there as a whole; all by default.
        """
        found = self._headers(self._place.names() if names is None else names)
        return {name: header for name, header in found if isinstance(header, TakeHeader)}

    def header(self, name: str) -> TakeHeader:
        """Description, number of frames, cameras and hash of one take; reads no pixels.

        Raises:
            TakeError: the take is missing, torn, or of another format version.
        """
        _check_name(name)
        where, data = self._place.describe(name), self._place.header(name)
        if data is None and not self._place.is_there(name):
            raise TakeError(f"take {name!r}: no folder {where}; check the name, or generate the take")
        header = parse_header(name, where, data)
        there = self._place.sizes(name, header.files)
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
        return self._as_folder().path(name)

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
        """One camera's frames of a take with their ground truth, loading nothing else; raises as :meth:`read`."""
        with self._opened(name, frames) as stored:
            return stored.view(view)

    def read_clip(self, name: str, view: int = 0, *, frames: slice | None = None) -> Clip:
        """One camera's frames of a take without any ground truth, loading nothing else; raises as :meth:`read`."""
        with self._opened(name, frames) as stored:
            return stored.clip(view)

    def read_small_arrays(self, name: str) -> dict[str, np.ndarray]:
        """Every array of a take but its pixels, by path such as ``view_0/visible``; raises as :meth:`read`."""
        small = [key for key in ("cam_from_world", *VIEW_ARRAYS) if key not in PIXEL_ARRAYS]
        with self._opened(name) as stored:
            of_views = [f"view_{v}/{key}" for v in range(len(stored.header.cameras)) for key in small]
            return {path: stored.read(path) for path in (*TAKE_ARRAYS, *of_views)}

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
        if not self._place.may_write(name):
            raise TakeError(
                f"take {name!r}: {self._place.describe(name)} exists and takes are written once; delete it or "
                "choose another name"
            )
        self._place.write(name, lambda arrays_at: _take_files(take, arrays_at))

    def _as_folder(self) -> _Folder:
        if not isinstance(self._place, _Folder):
            raise TakeError(f"store {self.url}: expected a folder of takes, and this is an object store")
        return self._place

    def _headers(self, names: Iterable[str]) -> list[tuple[str, TakeHeader | TakeError]]:
        chosen = list(names)
        if self.is_folder or len(chosen) < 2:
            return [(name, self._try_header(name)) for name in chosen]
        with ThreadPoolExecutor(_HEADERS_AT_ONCE) as pool:
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
        where = self._place.describe(name)
        with reading(f"take {name!r}: {where} is torn: an array", TakeError, REMEDY), self._place.reaching():
            store, path = self._place.zarr_group(name, header.arrays_at)
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
    root = Path(path).parent if isinstance(path, Path) or "://" not in parent else parent
    return TakeStore(root), last.removesuffix(SUFFIX)


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


def _open_place(root: str | Path) -> _Folder | _Bucket:
    text = str(root)
    if re.match(r"[a-z][a-z0-9]+:/([^/]|$)", text):  # not a drive letter
        raise ConfigError(f"store {text}: a URL needs two slashes, such as s3://bucket/takes; a Path loses one of them")
    if "://" not in text:
        return _Folder(Path(root))
    parts = urlsplit(text)
    return _Folder(Path(url2pathname(parts.path))) if parts.scheme == "file" else _Bucket(text)


class _Folder:
    """Takes in a folder: lists them, reads their headers, and writes the files of new ones."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.url = str(folder)

    def path(self, name: str) -> Path:
        return self.folder / f"{name}{SUFFIX}"

    def exists(self) -> bool:
        return self.folder.is_dir()

    def names(self) -> list[str]:
        """Names of all folders that look like takes, sorted."""
        found = (p for p in self.folder.glob(f"*{SUFFIX}") if p.is_dir() and p.name[0] != ".")
        return sorted(p.name.removesuffix(SUFFIX) for p in found)

    def describe(self, name: str) -> str:
        return str(self.path(name))

    def is_there(self, name: str) -> bool:
        return self.path(name).is_dir()

    def may_write(self, name: str) -> bool:
        """Whether nothing of that name exists: a folder appears whole, so whatever is there is meant."""
        return not self.path(name).exists()

    def header(self, name: str) -> bytes | None:
        """Content of a take's header; None if it has none."""
        file = self.path(name) / HEADER_FILE
        if not file.exists():
            return None
        require_file(file, TakeError)
        return file.read_bytes()

    def sizes(self, name: str, files: Mapping[str, int]) -> dict[str, int]:
        """Sizes in bytes of those files that are there, by path relative to the take."""
        found, folder = {}, str(self.path(name))
        for path in files:
            try:
                found[path] = os.stat(f"{folder}/{path}").st_size
            except (FileNotFoundError, NotADirectoryError):
                continue
        return found

    def zarr_group(self, name: str, arrays_at: str) -> tuple[StoreLike, str]:
        """Zarr store and path in it of the group that holds a take's arrays."""
        return str(self.path(name)), arrays_at

    def write(self, name: str, files: _Files) -> None:
        """Write a new take; a TakeError if another process wrote one of this name meanwhile."""
        self.folder.mkdir(parents=True, exist_ok=True)
        _remove_abandoned(self.folder)
        temporary = self.folder / f"{_TEMPORARY}{socket.gethostname()}-{os.getpid()}-{uuid.uuid4().hex[:8]}"
        try:
            for path, data in files(""):
                file = temporary / path
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_bytes(data)
            _sync(temporary)
            try:
                temporary.rename(self.path(name))
            except OSError as error:
                if self.path(name).exists():
                    raise _written_meanwhile(self, name) from error
                raise
            _sync_one(self.folder)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)

    def reaching(self) -> AbstractContextManager[None]:
        return nullcontext()  # what the file system says is said


def _remove_abandoned(root: Path) -> None:
    """Remove what killed writers left behind, but not what living ones are writing."""
    for folder in root.glob(f"{_TEMPORARY}*"):
        host, _, rest = folder.name.removeprefix(_TEMPORARY).rpartition("-")[0].rpartition("-")
        ours = host == socket.gethostname() and rest.isdecimal()
        try:
            age_s = time.time() - folder.stat().st_mtime
        except FileNotFoundError:  # its writer has just finished
            continue
        if (ours and not _is_running(int(rest))) or age_s > _ABANDONED_AFTER_S:
            shutil.rmtree(folder, ignore_errors=True)


def _is_running(pid: int) -> bool:
    if os.name != "posix":  # signal 0 would be delivered as an interrupt there; age decides instead
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass  # of another user
    return True


def _sync(folder: Path) -> None:
    """Force every file and folder under ``folder`` to the disk, so that the rename cannot come first."""
    walked = list(os.walk(folder))
    # Side by side, because a disk takes many at a time and each waits for it.
    with ThreadPoolExecutor(_SYNCS_AT_ONCE) as pool:
        list(pool.map(_sync_one, [Path(parent) / file for parent, _, names in walked for file in names]))
        list(pool.map(_sync_one, [Path(parent) for parent, _, _ in walked]))


def _sync_one(path: Path) -> None:
    folder = path.is_dir()
    if folder and os.name != "posix":  # folders cannot be opened elsewhere
        return
    descriptor = os.open(path, os.O_RDONLY if folder else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


class _Bucket:
    """Takes under a URL such as ``s3://bucket/takes``, with the methods of a folder.

    Endpoint, region and credentials come from the environment, by the names that the provider's own tools use
    (``AWS_ENDPOINT_URL``, ``AWS_ACCESS_KEY_ID``, ``GOOGLE_APPLICATION_CREDENTIALS``, ``AZURE_STORAGE_ACCOUNT_NAME``).
    ``memory://NAME`` lives as long as the process.
    """

    def __init__(self, url: str) -> None:
        self.url = url.rstrip("/")
        parts = urlsplit(self.url)
        if parts.scheme not in SCHEMES or not parts.netloc:
            raise ConfigError(
                f"store {url}: expected a folder, file://PATH or {', '.join(SCHEMES[:4])}://BUCKET/PREFIX"
            )
        self._obstore = require("obstore")
        if parts.scheme == "memory":
            self._store = _memories.setdefault(parts.netloc, require("obstore.store").MemoryStore())
            self._prefix = parts.path.strip("/")
        else:
            self._store, self._prefix = self._open(), ""

    def _open(self) -> Any:
        plain = os.environ.get("AWS_ENDPOINT_URL", "").startswith("http://")
        try:
            return require("obstore.store").from_url(
                self.url,
                client_options={"allow_http": True} if plain else None,
                retry_config={"max_retries": 5, "retry_timeout": timedelta(seconds=60)},
            )
        except require("obstore.exceptions").BaseError as error:
            raise ConfigError(f"store {self.url}: {_brief(error)}; see docs/scale.md for its settings") from error

    @contextmanager
    def reaching(self) -> Iterator[None]:
        """Turns what goes wrong between here and there into a StoreError."""
        try:
            yield
        except (require("obstore.exceptions").BaseError, PermissionError) as error:
            raise StoreError(
                f"store {self.url}: cannot be reached or used ({_brief(error)}); check the URL, the endpoint and "
                "the credentials in the environment, and try again"
            ) from error

    def exists(self) -> bool:
        return bool(self.names())

    def names(self) -> list[str]:
        with self.reaching():
            found = self._obstore.list_with_delimiter(self._store, self._prefix or None)["common_prefixes"]
        last = (path.rpartition("/")[2] for path in found)
        return sorted(name.removesuffix(SUFFIX) for name in last if name.endswith(SUFFIX) and name[0] != ".")

    def describe(self, name: str) -> str:
        return f"{self.url}/{name}{SUFFIX}"

    def is_there(self, name: str) -> bool:
        with self.reaching():
            return next(iter(self._obstore.list(self._store, self._key(name), chunk_size=1)), None) is not None

    def may_write(self, name: str) -> bool:
        """Whether there is no header: without one, whatever is there was left by a killed writer."""
        return self.header(name) is None

    def header(self, name: str) -> bytes | None:
        with self.reaching():
            try:
                return bytes(self._obstore.get(self._store, self._key(name, HEADER_FILE)).bytes())
            except FileNotFoundError:
                return None

    def sizes(self, name: str, files: Mapping[str, int] | None = None) -> dict[str, int]:
        """Sizes in bytes of all objects of a take, by path relative to it; one request however many there are."""
        start = len(self._key(name)) + 1
        with self.reaching():
            pages = self._obstore.list(self._store, self._key(name))
            return {found["path"][start:]: found["size"] for page in pages for found in page}

    def zarr_group(self, name: str, arrays_at: str) -> tuple[StoreLike, str]:
        from zarr.storage import ObjectStore

        return ObjectStore(self._store, read_only=True), self._key(name, arrays_at)

    def write(self, name: str, files: _Files) -> None:
        """Write a new take; what was not committed is removed, unless its header may have arrived all the same."""
        writer = f"written-{uuid.uuid4().hex[:12]}"
        with self.reaching():
            try:
                header = self._put_arrays(name, files(writer))
            except BaseException:
                self._remove(name, lambda path: path.startswith(writer))
                raise
            self.commit(name, writer, header)

    def _put_arrays(self, name: str, files: Iterator[tuple[str, bytes | memoryview]]) -> bytes:
        """Put all but the header, which is handed back, a few at a time and no faster than they go."""
        pending, header = deque[Future[Any]](), b""
        with ThreadPoolExecutor(_PUTS_AT_ONCE, thread_name_prefix="quest-put") as pool:
            try:
                for path, data in files:
                    if path == HEADER_FILE:
                        header = bytes(data)
                        continue
                    if len(pending) >= 2 * _PUTS_AT_ONCE:
                        pending.popleft().result()
                    pending.append(pool.submit(self._obstore.put, self._store, self._key(name, path), data))
                for put in pending:
                    put.result()
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
        return header

    def commit(self, name: str, writer: str, header: bytes) -> None:
        """Put a take's header and remove what other writers left; a TakeError if the take has a header already."""
        errors = require("obstore.exceptions")
        key = self._key(name, HEADER_FILE)
        try:
            self._obstore.put(self._store, key, header, mode="create")
        except errors.AlreadyExistsError as error:
            if self.header(name) != header:  # else it is ours: the answer to the first attempt was lost on its way
                self._remove(name, lambda path: path.startswith(writer))
                raise _written_meanwhile(self, name) from error
        except errors.NotSupportedError:
            # A store that cannot compare: the last of two writers wins, and neither may remove what the other has put.
            self._obstore.put(self._store, key, header)
            return
        self._remove(name, lambda path: path != HEADER_FILE and not path.startswith(writer))

    def _remove(self, name: str, which: Callable[[str], bool]) -> None:
        try:
            keys = [self._key(name, path) for path in self.sizes(name) if which(path)]
            if keys:
                self._obstore.delete(self._store, keys)
        except (require("obstore.exceptions").BaseError, TakeError, OSError):
            pass  # rubbish in nobody's way; the take itself is either there or not

    def _key(self, name: str, path: str = "") -> str:
        return "/".join(filter(None, (self._prefix, f"{name}{SUFFIX}", path)))


def _written_meanwhile(place: _Folder | _Bucket, name: str) -> TakeError:
    return TakeError(f"take {name!r}: {place.describe(name)} was written by another process meanwhile")


def _brief(error: Exception) -> str:
    """What an error of obstore says before it comes to its sources; of a server's XML only code and message."""
    text = str(error).partition("\n\nDebug source")[0]
    told = re.search(r"<Code>(.*?)</Code>\s*<Message>(.*?)</Message>", text, re.DOTALL)
    return f"{text.partition('<?xml')[0]}{told[1]}, {told[2]}" if told else " ".join(text.split())


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
