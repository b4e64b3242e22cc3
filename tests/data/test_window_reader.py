"""Windows read fast are the windows that the store reads."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from quest.data.store import TakeStore
from quest.data.take_format import take_arrays
from quest.data.window_reader import Window, WindowReader
from quest.errors import TakeError
from quest.types import Take
from tests.synthetic import make_take


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> TakeStore:
    """One take of two shards with a chunk that is not full, one shorter than a chunk, one without depth."""
    store = TakeStore(tmp_path_factory.mktemp("windows") / "store")
    store.write(make_take(frames=66, views=2, size=(24, 20), name="long"))
    short = make_take(frames=3, views=1, size=(24, 20), name="short")
    store.write(short)
    bare = replace(short.views[0], clip=replace(short.views[0].clip, depth_m=None))
    store.write(replace(short, views=(bare,), info=replace(short.info, name="bare")))
    return store


def same(found: Take, expected: Take) -> bool:
    pairs = zip(take_arrays(found), take_arrays(expected), strict=True)
    return found.info == expected.info and all(
        a == b and x.dtype == y.dtype and np.array_equal(x, y) for (a, x), (b, y) in pairs
    )


WINDOWS = [
    Window("long", 0, 0, 4),
    Window("long", 1, 3, 4),
    Window("long", 1, 58, 4),
    Window("long", 0, 62, 4),
    Window("long", 0, 65, 1),
    Window("long", 1, 0, 66),
    Window("short", 0, 0, 3),
    Window("bare", 0, 1, 2),
]


@pytest.mark.parametrize("window", WINDOWS)
def test_equals_the_store(window: Window, store: TakeStore):
    with WindowReader(store) as reader:
        found = reader.read(window)
    expected = store.read(window.take, views=[window.view], frames=slice(window.start, window.start + window.frames))
    assert same(found, expected)
    assert (found.views[0].clip.depth_m is None) == (window.take == "bare")


def test_batches_keep_their_order_and_own_their_arrays(store: TakeStore):
    with WindowReader(store, threads=3, takes_in_memory=1) as reader:
        found = reader.batch(WINDOWS * 3)
        for window, take in zip(WINDOWS * 3, found, strict=True):
            assert (take.info.name, len(take)) == (window.take, window.frames)
        found[0].point_world[:] = 0  # what a caller writes must not come back
        assert same(reader.read(WINDOWS[0]), found[8])


def test_small_arrays_and_byte_ranges(store: TakeStore):
    with WindowReader(store) as reader:
        small = reader.small_arrays("long")
        assert np.array_equal(small["view_1/visible"], store.read("long").views[1].visible)
        assert "view_0/rgb" not in small
        ranges = reader.byte_ranges(Window("long", 0, 58, 4))
    assert len(ranges) == 4 * 2  # four pixel arrays, a chunk in each of two shards
    assert all(begin + size <= path.stat().st_size for path, begin, size in ranges)


def test_other_layouts_are_read_by_the_store(store: TakeStore, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("quest.data.window_reader._CODECS", ["bytes", "gzip"])
    with WindowReader(store) as reader:
        assert same(reader.read(WINDOWS[1]), store.read("long", views=[1], frames=slice(3, 7)))
        assert reader.byte_ranges(WINDOWS[1]) == []
        assert set(reader.small_arrays("bare")) >= {"view_0/visible", "point_world"}


@pytest.mark.parametrize(
    "window", [Window("long", 2, 0, 4), Window("long", 0, 64, 4), Window("long", 0, -1, 2), Window("long", 0, 3, 0)]
)
def test_no_such_window(window: Window, store: TakeStore):
    with WindowReader(store) as reader, pytest.raises(TakeError, match="it has 66 frames and 2 views"):
        reader.read(window)


def test_damage_is_noticed(tmp_path: Path):
    store = TakeStore(tmp_path)
    store.write(make_take(frames=8, views=1, size=(24, 20), name="panels"))
    shard = next(path for path in (store.path("panels") / "view_0" / "rgb" / "c").rglob("*") if path.is_file())
    data = bytearray(shard.read_bytes())
    data[5] ^= 255
    shard.write_bytes(data)
    with WindowReader(store) as reader, pytest.raises(TakeError, match=r"torn.*check sum"):
        reader.read(Window("panels", 0, 0, 4))
    for array in ("visible", "rgb"):
        meta = store.path("panels") / "view_0" / array / "zarr.json"
        kept = meta.read_bytes()
        for damaged in (
            json.dumps({"a": 1}).encode().ljust(len(kept)),
            bytes(len(kept)),
            kept.replace(b"shape", b"shaqe"),
        ):
            meta.write_bytes(damaged)
            with WindowReader(store) as reader, pytest.raises(TakeError, match="torn"):
                reader.read(Window("panels", 0, 4, 4))
        meta.write_bytes(kept)
