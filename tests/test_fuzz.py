"""Any damage to any file that is read ends in an answer or in one of our errors; ``make fuzz`` tries thousands."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import shutil
import struct
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import quest
from quest.data.lerobot_export import Episode, export_lerobot
from quest.data.recording import read_recording, write_recording
from quest.data.stats import store_stats
from quest.data.store import TakeStore
from quest.errors import QuestError
from quest.model.weights import save_network
from quest.sim.objects import load_object
from quest.tracks import read_tracks, write_tracks
from quest.types import Clip, Query
from tests.data.bags import recording, write_bag, write_mcap, write_ros1
from tests.data.layout_writers import nerfstudio, record3d, rscan, stray, tum
from tests.sim.small_objects import write_cabinet
from tests.synthetic import make_take
from tests.tiny import make_finder
from tests.track.clips import make_clip, make_tracker

EXAMPLES = int(os.environ.get("QUEST_FUZZ", "8"))
"""Damages tried of each kind of file."""
LONGEST_S = 5.0
MOST_KIB = 2**20

NASTY = st.sampled_from(
    [
        *(None, True, False, [], {}, [[]], [None], {"": None}, ""),
        *("x", "../x", "/", "\0", "\x1b[2J", "n" * 300, "NaN", "1e999"),
        *("{", "{chunk_index:2000000000d}", "{0.__class__}"),
        *(0, -1, 1, 3, 2**31, 2**63, -(2**63), 10**40, 0.5, -0.0, 1e-300, 1e300),
    ]
)


def make_small() -> Clip:
    return make_clip(frames=3, size=(40, 32))


def write_takes(folder: Path) -> None:
    store = TakeStore(folder / "s")
    for seed in range(2):
        store.write(make_take(frames=3, views=1, entities=1, size=(16, 16), seed=seed))


def read_takes(folder: Path) -> None:
    store = TakeStore(folder / "s")
    assert len(store.problems()) < 2, "one damaged take hides the other"
    for name in store.names():
        store.read(name)
    store_stats(store, report=lambda done, total: None)


def write_answers(folder: Path) -> None:
    clip = make_clip(frames=3)
    write_tracks(make_tracker().track(clip, [Query.point(0, 20.0, 20.0)]), folder / "t.parquet")


def write_stream(folder: Path) -> None:
    tracker, clip = make_tracker(), make_clip(frames=3)
    stream = tracker.stream(clip.camera, [Query.point(0, 20.0, 20.0)])
    stream.step(clip.rgb[0], None, 0.0)
    (folder / "stream.bin").write_bytes(tracker.save(stream))


KINDS: dict[str, tuple[Callable[[Path], object], Callable[[Path], object]]] = {
    "folder": (
        lambda f: write_recording(make_small(), f / "r", rgb="png"),
        lambda folder: read_recording(folder / "r"),
    ),
    "video": (lambda f: write_recording(make_small(), f / "r"), lambda folder: read_recording(folder / "r")),
    "takes": (write_takes, read_takes),
    "lerobot": (
        lambda f: export_lerobot([Episode.of_take(make_take(frames=3, views=1, entities=1, size=(32, 32)))], f / "d"),
        lambda folder: read_recording(folder / "d"),
    ),
    "tracks": (write_answers, lambda folder: read_tracks(folder / "t.parquet")),
    "stream": (write_stream, lambda folder: make_tracker().restore((folder / "stream.bin").read_bytes())),
    "weights": (
        lambda f: save_network(f / "w.safetensors", make_finder(), settings="{}", about="made up"),
        lambda f: quest.load(f / "w.safetensors", monitor=False),
    ),
    "object": (lambda folder: write_cabinet(folder / "cabinet"), lambda folder: load_object(folder / "cabinet")),
    "mcap": (lambda f: write_mcap(f / "b.mcap", recording()), lambda folder: read_recording(folder / "b.mcap")),
    "tum": (tum, lambda folder: read_recording(folder / "rgbd_dataset_own")),
    "7-scenes": (rscan, read_recording),
    "record3d": (record3d, read_recording),
    "stray": (stray, read_recording),
    "nerfstudio": (nerfstudio, read_recording),
    "bag": (lambda f: write_bag(f / "b", recording()), lambda folder: read_recording(folder / "b")),
    "ros1": (lambda f: write_ros1(f / "b.bag", recording()), lambda folder: read_recording(folder / "b.bag")),
    "ros1-bz2": (
        lambda f: write_ros1(f / "b.bag", recording(), compression="BZ2"),
        lambda f: read_recording(f / "b.bag"),
    ),
    "ros1-lz4": (
        lambda f: write_ros1(f / "b.bag", recording(), compression="LZ4"),
        lambda f: read_recording(f / "b.bag"),
    ),
}
"""What writes files of each kind into a folder, and what reads them."""


@contextlib.contextmanager
def limits() -> Iterator[None]:
    """Fail at what takes long, or much memory for files of some kilobytes."""
    begun_s, before = time.monotonic(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield
    assert time.monotonic() - begun_s < LONGEST_S
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < MOST_KIB


def damaging(kind: str, whole: Path, folder: Path) -> Callable[[], None]:
    """A Hypothesis test that damages whole files of a kind at random and reads them.

    Args:
        kind: one of :data:`KINDS`.
        whole: where whole files are written.
        folder: where the damaged ones go.
    """
    write, read = KINDS[kind]
    whole.mkdir(exist_ok=True)
    write(whole)
    read(whole)
    files = sorted(path.relative_to(whole) for path in whole.rglob("*") if path.is_file())

    @settings(max_examples=EXAMPLES, deadline=None, derandomize=EXAMPLES < 100, database=None,
              suppress_health_check=(HealthCheck.too_slow, HealthCheck.data_too_large))  # fmt: skip
    @given(st.data())
    def damage(data: st.DataObject) -> None:
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(whole, folder)
        file = folder / data.draw(st.sampled_from(files))
        file.write_bytes(spoiled(file.read_bytes(), data))
        with contextlib.suppress(QuestError), limits():
            read(folder)

    return damage


@pytest.mark.plain
@pytest.mark.parametrize("kind", KINDS)
def test_damaged_files_end_in_our_errors(kind: str, tmp_path: Path) -> None:
    damaging(kind, tmp_path / "whole", tmp_path / "damaged")()
    assert {path.name for path in tmp_path.iterdir()} <= {"whole", "damaged"}, "written elsewhere"


def spoiled(content: bytes, data: st.DataObject) -> bytes:
    """The same bytes with something wrong: a value of their JSON, a bit, an end, a hole."""
    start, stop = json_in(content)
    if start < stop and data.draw(st.booleans()):
        text = json.dumps(changed(json.loads(content[start:stop]), data)).encode()
        head = struct.pack("<Q", len(text)) if start == 8 else content[:start]
        return head + text + content[stop:]
    at = data.draw(st.integers(0, max(len(content) - 1, 0)))
    how = data.draw(st.sampled_from(["flip", "cut", "hole", "insert", "word"]))
    if how == "cut":
        return content[:at]
    if how == "insert":
        return content[:at] + data.draw(st.binary(min_size=1, max_size=9)) + content[at:]
    if how == "word":
        number = struct.pack("<Q", data.draw(st.sampled_from([0, 2**31 - 1, 2**32 - 1, 2**60, 2**64 - 1])))
        return content[:at] + number + content[at + 8 :]
    if how == "hole":
        return content[:at] + bytes(min(64, len(content) - at)) + content[at + 64 :]
    turned = bytes([content[at] ^ (1 << data.draw(st.integers(0, 7)))]) if content else b""
    return content[:at] + turned + content[at + 1 :]


def json_in(content: bytes) -> tuple[int, int]:
    """Where in some bytes there is JSON: all of them, or the header of safetensors; nowhere is 0, 0."""
    if content[:1] in (b"{", b"["):
        return 0, len(content)
    length = int.from_bytes(content[:8], "little")
    return (8, 8 + length) if content[8:9] == b"{" and length < len(content) else (0, 0)


def changed(value: Any, data: st.DataObject) -> Any:
    """JSON in which one value, at any depth, is another one or is gone."""
    if not isinstance(value, dict | list) or not value or data.draw(st.integers(0, 3)) == 0:
        return data.draw(NASTY)
    keys = list(value) if isinstance(value, dict) else list(range(len(value)))
    key = keys[data.draw(st.integers(0, len(keys) - 1))]
    inner = value[key]
    if isinstance(inner, str) and inner[:1] == "{":  # JSON in a text, as in the metadata of safetensors
        inner = json.dumps(changed(json.loads(inner), data))
        return {**value, key: inner} if isinstance(value, dict) else [*value[:key], inner, *value[key + 1 :]]
    if data.draw(st.integers(0, 5)) == 0:
        kept = [k for k in keys if k != key]
        return {k: value[k] for k in kept} if isinstance(value, dict) else [value[k] for k in kept]
    inner = changed(inner, data)
    return {**value, key: inner} if isinstance(value, dict) else [*value[:key], inner, *value[key + 1 :]]
