"""Random windows of takes, fast: a few frames of one view with their truth, as training draws them.

:meth:`TakeStore.read` answers the same question, but opens the group and every array anew and walks through Zarr's
general machinery each time, which costs several times what decoding costs. Here descriptions and the small arrays of a
take stay in memory, and of the pixels exactly the chunks that hold the wanted frames are read and decoded. No file
stays open: a day's rendering has more shards than a process may have files.

Reference: the Zarr v3 specification, codec ``sharding_indexed``, for where a chunk lies in its shard.
"""

from __future__ import annotations

import json
import os
import threading
import zlib
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from io import FileIO
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

import google_crc32c
import numpy as np
from numcodecs import blosc  # type: ignore[attr-defined]

from quest.data.store import PIXEL_ARRAYS, TakeStore
from quest.data.take_format import TAKE_ARRAYS, VIEW_ARRAYS, TakeHeader, decode_depth, take_arrays
from quest.errors import TakeError
from quest.types import Clip, Take, View

_CODECS = ["bytes", "blosc", "crc32c"]
_INDEX_CODECS = ["bytes", "crc32c"]
_CRC_BYTES = 4
_ENTRY_BYTES = 16
"""Where a chunk begins and how long it is, 64 bits each."""


class Window(NamedTuple):
    """Some consecutive frames of one view of a take."""

    take: str
    view: int
    start: int
    frames: int


class WindowReader:
    """Reads windows of the takes of a store, from several threads if wanted; a context manager.

    Takes whose arrays are laid out in another way than the store writes them, or that are not on a local disk, are
    read through :meth:`TakeStore.read`: slower, with the same result.

    Args:
        store: where the takes are.
        threads: how many windows :meth:`batch` decodes side by side.
        takes_in_memory: of how many takes descriptions and small arrays are kept; those used longest ago go first.
    """

    def __init__(self, store: TakeStore, *, threads: int = 2, takes_in_memory: int = 4096) -> None:
        self._store = store
        self._local = store.is_folder
        self._open: OrderedDict[str, _OpenTake] = OrderedDict()
        self._room = takes_in_memory
        self._lock = threading.Lock()
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="windows")

    def __enter__(self) -> WindowReader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the threads."""
        self._pool.shutdown(cancel_futures=True)

    def read(self, window: Window) -> Take:
        """The frames of a window: equal to ``store.read(take, views=[view], frames=slice(start, start + frames))``.

        Raises:
            TakeError: the take is missing or torn, or has no such view or frames.
        """
        take = self._take(window.take)
        end = window.start + window.frames
        if not (0 <= window.view < len(take.header.cameras) and 0 <= window.start < end <= take.header.frames):
            raise TakeError(
                f"take {window.take!r}: no frames {window.start} to {end - 1} of view {window.view}; it has "
                f"{take.header.frames} frames and {len(take.header.cameras)} views"
            )
        if not take.shards:
            return self._store.read(window.take, views=[window.view], frames=slice(window.start, end))
        return take.read(window.view, window.start, end)

    def batch(self, windows: Iterable[Window]) -> list[Take]:
        """Several windows, in order, decoded by several threads.

        Raises:
            TakeError: as :meth:`read`.
        """
        return list(self._pool.map(self.read, windows))

    def small_arrays(self, name: str) -> Mapping[str, np.ndarray]:
        """Every array of a take but its pixels, by path in the group, such as ``view_0/visible``; not to be changed.

        Raises:
            TakeError: the take is missing or torn.
        """
        take = self._take(name)
        if take.small:
            return take.small
        arrays = dict(take_arrays(self._store.read(name)))
        return {path: array for path, array in arrays.items() if path.rpartition("/")[2] not in PIXEL_ARRAYS}

    def byte_ranges(self, window: Window) -> list[tuple[Path, int, int]]:
        """File, offset and size of everything that :meth:`read` has to read for a window; empty for other layouts."""
        shards = self._take(window.take).shards
        mine = [array for path, array in shards.items() if path.startswith(f"view_{window.view}/")]
        return [r for array in mine for r in array.byte_ranges(window.start, window.start + window.frames)]

    def _take(self, name: str) -> _OpenTake:
        with self._lock:
            if name in self._open:
                self._open.move_to_end(name)
                return self._open[name]
        opened = self._open_take(name)
        with self._lock:
            self._open[name] = opened
            while len(self._open) > self._room:
                self._open.popitem(last=False)
        return opened

    def _open_take(self, name: str) -> _OpenTake:
        header = self._store.header(name)
        if not self._local:
            return _OpenTake(header, {}, {})
        folder = self._store.path(name) / header.arrays_at
        shards = _find_shards(name, folder, header)
        return _OpenTake(header, _small_arrays(name, folder, header) if shards else {}, shards)


@dataclass(frozen=True)
class _OpenTake:
    """What is kept of a take: its description, its small arrays, and where its pixels lie."""

    header: TakeHeader
    small: dict[str, np.ndarray]
    shards: dict[str, _ShardedArray]

    def read(self, view: int, start: int, end: int) -> Take:
        def of_view(key: str) -> np.ndarray:
            path = f"view_{view}/{key}"
            return self.shards[path].read(start, end) if path in self.shards else self.small[path][start:end].copy()

        header = self.header
        arrays = {key: self.small[key][start:end].copy() for key in TAKE_ARRAYS}
        clip = Clip(
            name=header.clip_names[view],
            camera=header.cameras[view],
            rgb=of_view("rgb"),
            depth_m=decode_depth(of_view("depth")) if header.has_depth[view] else None,
            stamp_s=arrays["stamp_s"],
            cam_from_world=of_view("cam_from_world"),
        )
        return Take(header.info, (View(clip, **{key: of_view(key) for key in VIEW_ARRAYS}),), **arrays)


@dataclass(frozen=True)
class _ShardedArray:
    """An array in shards along its first axis, each with an index of its chunks at its end.

    Attributes:
        take: name of the take, for messages.
        folder: of the array.
        shape: of the whole array.
        dtype: of the whole array.
        chunk: frames of a chunk.
        shard: frames of a shard.
    """

    take: str
    folder: Path
    shape: tuple[int, ...]
    dtype: np.dtype
    chunk: int
    shard: int
    _indices: dict[int, np.ndarray] = field(default_factory=dict)

    def read(self, start: int, end: int) -> np.ndarray:
        """The frames ``start`` to ``end``."""
        out = np.empty((end - start, *self.shape[1:]), self.dtype)
        chunk_shape = (self.chunk, *self.shape[1:])
        for shard in range(start // self.shard, (end - 1) // self.shard + 1):
            path = self._path(shard)
            try:
                with path.open("rb", buffering=0) as file:
                    for c, begin, size in self._chunks(shard, file, start, end):
                        data = _without_crc(_read_at(file, begin, size))
                        low, high = max(start, c * self.chunk), min(end, (c + 1) * self.chunk)
                        if high - low == self.chunk:
                            blosc.decompress(data, out[low - start : high - start])
                        else:
                            frames = np.frombuffer(blosc.decompress(data), self.dtype).reshape(chunk_shape)
                            out[low - start : high - start] = frames[low - c * self.chunk : high - c * self.chunk]
            except (OSError, ValueError, RuntimeError) as error:
                raise TakeError(
                    f"take {self.take!r}: {path} is torn, frames {start} to {end - 1} cannot be decoded ({error}); "
                    "delete its folder and generate it again"
                ) from error
        return out

    def byte_ranges(self, start: int, end: int) -> Iterator[tuple[Path, int, int]]:
        """File, offset and size of every chunk that holds some of the frames ``start`` to ``end``."""
        for shard in range(start // self.shard, (end - 1) // self.shard + 1):
            path = self._path(shard)
            with path.open("rb", buffering=0) as file:
                ranges = list(self._chunks(shard, file, start, end))
            yield from ((path, begin, size) for _, begin, size in ranges)

    def _path(self, shard: int) -> Path:
        return self.folder.joinpath("c", str(shard), *["0"] * (len(self.shape) - 1))

    def _chunks(self, shard: int, file: FileIO, start: int, end: int) -> Iterator[tuple[int, int, int]]:
        """Number, offset and size of the chunks of a shard that hold some of the frames."""
        first, last = max(start, shard * self.shard), min(end, (shard + 1) * self.shard)
        index = self._index(shard, file)
        for c in range(first // self.chunk, (last - 1) // self.chunk + 1):
            begin, size = (int(n) for n in index[c - shard * self.shard // self.chunk])
            yield c, begin, size

    def _index(self, shard: int, file: FileIO) -> np.ndarray:
        if shard not in self._indices:
            size = self.shard // self.chunk * _ENTRY_BYTES + _CRC_BYTES
            data = _without_crc(_read_at(file, file.seek(0, os.SEEK_END) - size, size))
            self._indices[shard] = np.frombuffer(data, "<u8").reshape(-1, 2)
        return self._indices[shard]


def _read_at(file: FileIO, begin: int, size: int) -> bytes:
    file.seek(begin)
    data = file.read(size)
    if len(data) != size:
        raise ValueError(f"expected {size} bytes at {begin}, got {len(data)}")
    return data


def _without_crc(data: bytes) -> memoryview:
    body = memoryview(data)[:-_CRC_BYTES]
    if google_crc32c.value(bytes(body)) != int.from_bytes(data[-_CRC_BYTES:], "little"):
        raise ValueError("the check sum differs")
    return body


def _find_shards(name: str, folder: Path, header: TakeHeader) -> dict[str, _ShardedArray]:
    """Every pixel array by path; empty unless all are laid out as the store writes them."""
    found = {}
    for v in range(len(header.cameras)):
        keys = ["rgb", "link_id", "entity_id", *(["depth"] if header.has_depth[v] else [])]
        for key in keys:
            try:
                array = _sharded_array(name, folder / f"view_{v}" / key)
            except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
                raise _torn(name, folder, error) from error
            if array is None:
                return {}
            found[f"view_{v}/{key}"] = array
    return found


def _sharded_array(name: str, folder: Path) -> _ShardedArray | None:
    meta = json.loads((folder / "zarr.json").read_text(encoding="utf-8"))
    shape, grid = tuple(meta["shape"]), meta["chunk_grid"]["configuration"]["chunk_shape"]
    sharding = meta["codecs"][0]
    inner = sharding.get("configuration", {})
    usual = (
        sharding["name"] == "sharding_indexed"
        and [codec["name"] for codec in inner["codecs"]] == _CODECS
        and [codec["name"] for codec in inner["index_codecs"]] == _INDEX_CODECS
        and inner.get("index_location", "end") == "end"
        and tuple(grid[1:]) == tuple(inner["chunk_shape"][1:]) == shape[1:]
        and meta["chunk_key_encoding"] == {"name": "default", "configuration": {"separator": "/"}}
    )
    if not usual:
        return None
    dtype = np.dtype(meta["data_type"]).newbyteorder("<")
    return _ShardedArray(name, folder, shape, dtype, inner["chunk_shape"][0], grid[0])


def _small_arrays(name: str, folder: Path, header: TakeHeader) -> dict[str, np.ndarray]:
    """Every array but the pixels, by path."""
    import zarr

    of_views = ("cam_from_world", "uv_px", "visible")
    paths = [*TAKE_ARRAYS, *(f"view_{v}/{key}" for v in range(len(header.cameras)) for key in of_views)]
    try:
        group = zarr.open_group(str(folder), mode="r", zarr_format=3, use_consolidated=False)
        return {path: np.asarray(group[path][:]) for path in paths}  # type: ignore[index]
    except (KeyError, ValueError, RuntimeError, OSError, TypeError, zlib.error) as error:
        raise _torn(name, folder, error) from error


def _torn(name: str, folder: Path, error: Exception) -> TakeError:
    return TakeError(
        f"take {name!r}: {folder} is torn, an array cannot be decoded ({type(error).__name__}: {error}); "
        "delete its folder and generate it again"
    )
