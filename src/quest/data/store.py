"""The take store: a folder with one Zarr v3 group per take, written once and never appended to.

Chunks hold a few frames, so that a window can be read alone; shards hold up to sixty, so that a take is a few dozen
files. Writing is atomic: everything goes to a hidden folder beside, and a rename makes it a take.
"""

from __future__ import annotations

import os
import shutil
import socket
import time
import uuid
import zlib
from collections.abc import Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from quest.data.take_format import (
    TAKE_ARRAYS,
    VIEW_ARRAYS,
    TakeHash,
    TakeHeader,
    check_take,
    decode_depth,
    list_files,
    read_header,
    take_arrays,
)
from quest.errors import QuestError, TakeError
from quest.types import Clip, Take, TakeInfo, View

if TYPE_CHECKING:
    from collections.abc import Iterator

    import zarr

FRAMES_PER_CHUNK = 4
FRAMES_PER_SHARD = 60
PIXEL_ARRAYS = ("rgb", "depth", "link_id", "entity_id")

_TEMPORARY = ".tmp-"
_ABANDONED_AFTER_S = 24 * 3600.0


class TakeStore:
    """Takes in a folder, one ``<name>.zarr`` group each.

    Args:
        root: the folder; made by the first :meth:`write`.
    """

    def __init__(self, root: str | Path) -> None:
        self.root = Path(root)

    def __repr__(self) -> str:
        return f"TakeStore({str(self.root)!r})"

    def __len__(self) -> int:
        return len(self.names())

    def __contains__(self, name: object) -> bool:
        if not isinstance(name, str):
            return False
        try:
            self.header(name)
        except TakeError:
            return False
        return True

    def names(self) -> list[str]:
        """Names of the whole takes, sorted; empty if the folder does not exist. See :meth:`problems` for the others."""
        return [name for name in self._folder_names() if name in self]

    def problems(self) -> dict[str, str]:
        """What is wrong with each folder that looks like a take but cannot be read, by name."""
        found = {}
        for name in self._folder_names():
            try:
                self.header(name)
            except TakeError as error:
                found[name] = str(error)
        return found

    def infos(self) -> dict[str, TakeInfo]:
        """Descriptions of all whole takes by name; reads no pixels."""
        return {name: header.info for name, header in self.headers().items()}

    def headers(self) -> dict[str, TakeHeader]:
        """Headers (description, number of frames, cameras, hash) of all whole takes by name; reads no pixels."""
        found = {}
        for name in self._folder_names():
            try:
                found[name] = self.header(name)
            except TakeError:
                continue  # reported by problems() and by read()
        return found

    def header(self, name: str) -> TakeHeader:
        """Description, number of frames, cameras and hash of one take; reads no pixels.

        Raises:
            TakeError: the take is missing, torn, or of another format version.
        """
        return read_header(self.path(name))

    def path(self, name: str) -> Path:
        """Folder of a take, there or not."""
        if not name or name.startswith(".") or "/" in name or "\\" in name:
            raise TakeError(f"take {name!r}: a name must not be empty, start with a dot or contain a slash")
        return self.root / f"{name}.zarr"

    def data_hash(self, name: str) -> str:
        """SHA-256 over the take's arrays and its description without provenance, as recorded when it was written."""
        return self.header(name).data_hash

    def read(self, name: str, *, views: Sequence[int] | None = None, frames: slice | None = None) -> Take:
        """A take, or only some of its views and frames.

        Args:
            name: the take.
            views: indices of the views to read; all by default, none for an empty sequence.
            frames: the frames to read; all by default. The motion of entities counts from the first one read.

        Raises:
            TakeError: the take is missing, torn or of another format version, or has no such view or frame.
        """
        header = self.header(name)
        rows = _frames(name, header, frames)
        with _opened(self.path(name)) as group:
            arrays = {
                key: _read_array(group, key, rows).astype(dtype, copy=False) for key, dtype in TAKE_ARRAYS.items()
            }
            chosen = range(len(header.cameras)) if views is None else views
            parts = tuple(_read_view(group, name, header, view, rows, arrays["stamp_s"]) for view in chosen)
        return Take(info=header.info, views=parts, **arrays)

    def read_view(self, name: str, view: int, *, frames: slice | None = None) -> View:
        """One camera's frames of a take with their ground truth, loading nothing else.

        Raises:
            TakeError: as :meth:`read`.
        """
        header = self.header(name)
        rows = _frames(name, header, frames)
        with _opened(self.path(name)) as group:
            return _read_view(group, name, header, view, rows, _read_array(group, "stamp_s", rows))

    def read_clip(self, name: str, view: int = 0, *, frames: slice | None = None) -> Clip:
        """One camera's frames of a take without any ground truth, loading nothing else.

        Raises:
            TakeError: as :meth:`read`.
        """
        header = self.header(name)
        rows = _frames(name, header, frames)
        with _opened(self.path(name)) as group:
            return _read_clip(group, name, header, view, rows, _read_array(group, "stamp_s", rows))

    def verify(self, name: str) -> None:
        """Read every array of a take and compare with its recorded hash.

        Raises:
            TakeError: a file was altered since the take was written.
        """
        take = self.read(name)
        recorded = self.data_hash(name)
        found = _hash(take)
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
        target = self.path(take.info.name)
        if target.exists():
            raise TakeError(
                f"take {take.info.name!r}: {target} exists and takes are written once; delete it or choose another name"
            )
        self.root.mkdir(parents=True, exist_ok=True)
        _remove_abandoned(self.root)
        temporary = self.root / f"{_TEMPORARY}{socket.gethostname()}-{os.getpid()}-{uuid.uuid4().hex[:8]}"
        try:
            _write_group(take, temporary)
            _sync(temporary)
            try:
                temporary.rename(target)
            except OSError as error:
                if target.exists():  # another process was faster
                    raise TakeError(
                        f"take {take.info.name!r}: {target} was written by another process meanwhile"
                    ) from error
                raise
            _sync_folder(self.root)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)

    def _folder_names(self) -> list[str]:
        if not self.root.is_dir():
            return []
        return sorted(p.name.removesuffix(".zarr") for p in self.root.glob("*.zarr") if p.is_dir() and p.name[0] != ".")


def open_clip(path: str | Path, *, view: int = 0, frames: slice | None = None) -> Clip:
    """The clip of one view of a take, by the take's folder (``store/take.zarr``).

    Raises:
        TakeError: the take is missing, torn or of another format version, or has no such view or frame.
    """
    folder = Path(path)
    if folder.suffix != ".zarr":
        raise TakeError(f"take {folder.name!r}: expected a folder <name>.zarr, got {folder}")
    return TakeStore(folder.parent).read_clip(folder.name.removesuffix(".zarr"), view, frames=frames)


def _frames(name: str, header: TakeHeader, frames: slice | None) -> slice:
    rows = slice(None) if frames is None else frames
    picked = range(header.frames)[rows]
    if len(picked) == 0 or picked.step < 1:
        raise TakeError(
            f"take {name!r}: {rows} picks no frame, or runs backwards; it has frames 0 to {header.frames - 1}"
        )
    return slice(picked.start, picked.stop, picked.step)


@contextmanager
def _opened(folder: Path) -> Iterator[zarr.Group]:
    """The open group; damage that only decoding shows becomes a TakeError."""
    import zarr

    try:
        yield zarr.open_group(str(folder), mode="r", zarr_format=3, use_consolidated=False)
    except QuestError:
        raise
    except (KeyError, ValueError, RuntimeError, OSError, TypeError, zlib.error) as error:
        raise TakeError(
            f"take {folder.stem!r}: {folder} is torn, an array cannot be decoded ({type(error).__name__}: {error}); "
            "delete its folder and generate it again"
        ) from error


def _read_array(group: zarr.Group, path: str, rows: slice) -> np.ndarray:
    return np.asarray(group[path][rows])  # type: ignore[index]


def _read_clip(group: zarr.Group, name: str, header: TakeHeader, view: int, rows: slice, stamp_s: np.ndarray) -> Clip:
    if not 0 <= view < len(header.cameras):
        raise TakeError(f"take {name!r}: no view {view}; it has views 0 to {len(header.cameras) - 1}")
    depth_m = decode_depth(_read_array(group, f"view_{view}/depth", rows)) if header.has_depth[view] else None
    return Clip(
        name=header.clip_names[view],
        camera=header.cameras[view],
        rgb=_read_array(group, f"view_{view}/rgb", rows),
        depth_m=depth_m,
        stamp_s=stamp_s,
        cam_from_world=_read_array(group, f"view_{view}/cam_from_world", rows),
    )


def _read_view(group: zarr.Group, name: str, header: TakeHeader, view: int, rows: slice, stamp_s: np.ndarray) -> View:
    clip = _read_clip(group, name, header, view, rows, stamp_s)
    return View(clip=clip, **{key: _read_array(group, f"view_{view}/{key}", rows) for key in VIEW_ARRAYS})


def _hash(take: Take) -> str:
    digest = TakeHash(take.info, tuple(view.clip.camera for view in take.views))
    for path, array in take_arrays(take):
        digest.add(path, array)
    return digest.hexdigest()


def _write_group(take: Take, folder: Path) -> None:
    import zarr

    digest = TakeHash(take.info, tuple(view.clip.camera for view in take.views))
    group = zarr.create_group(str(folder), zarr_format=3)
    for path, array in take_arrays(take):
        digest.add(path, array)
        _write_array(group, path, array)
    header = TakeHeader(
        info=take.info,
        frames=len(take),
        cameras=tuple(view.clip.camera for view in take.views),
        clip_names=tuple(view.clip.name for view in take.views),
        has_depth=tuple(view.clip.depth_m is not None for view in take.views),
        data_hash=digest.hexdigest(),
        files=list_files(folder),
    )
    group.update_attributes(header.to_attributes())


def _write_array(group: zarr.Group, path: str, array: np.ndarray) -> None:
    from zarr.codecs import BloscCodec, Crc32cCodec

    frames = len(array)
    options: dict[str, Any] = {"chunks": array.shape}
    if path.rpartition("/")[2] in PIXEL_ARRAYS:
        chunk = min(FRAMES_PER_CHUNK, frames)
        shard = min(FRAMES_PER_SHARD // chunk, -(-frames // chunk)) * chunk
        options = {"chunks": (chunk, *array.shape[1:]), "shards": (shard, *array.shape[1:])}
    options["chunks"] = tuple(max(1, n) for n in options["chunks"])  # a take without joints has empty arrays
    compressor = BloscCodec(cname="zstd", clevel=1, shuffle="shuffle", typesize=array.itemsize)
    stored = group.create_array(
        path,
        shape=array.shape,
        dtype=array.dtype,
        compressors=[compressor, Crc32cCodec()],
        # Empty chunks are written too, so that a chunk that is not there always means a torn take.
        config={"write_empty_chunks": True},
        **options,
    )
    stored[...] = array


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
        return True
    return True


def _sync(folder: Path) -> None:
    """Force every file and folder under ``folder`` to the disk, so that the rename cannot come first."""
    for parent, _, files in os.walk(folder):
        for file in files:
            descriptor = os.open(Path(parent) / file, os.O_RDWR)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
        _sync_folder(Path(parent))


def _sync_folder(folder: Path) -> None:
    if os.name != "posix":  # folders cannot be opened there
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
