"""The take store keeps takes whole: round trip, partial reads, torn takes, killed writers."""

from __future__ import annotations

import hashlib
import json
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from quest.data.store import TakeStore, open_clip
from quest.data.take_format import TakeHash, hash_take
from quest.errors import InputError, TakeError
from quest.types import Take
from tests.synthetic import make_take


@pytest.fixture(scope="module")
def take() -> Take:
    return make_take(frames=13, size=(24, 16), hinges=True, name="panels")


@pytest.fixture(scope="module")
def template(take: Take, tmp_path_factory: pytest.TempPathFactory) -> Path:
    store = TakeStore(tmp_path_factory.mktemp("template") / "store")
    store.write(take)
    return store.root


@pytest.fixture
def store(template: Path, tmp_path: Path) -> TakeStore:
    """A store with a take that a test may spoil."""
    return TakeStore(shutil.copytree(template, tmp_path / "store"))


def assert_equal(found: Take, expected: Take) -> None:
    assert found.info == expected.info
    for name in ("stamp_s", "point_world", "flow_world", "link_pose", "joint_position", "joint_velocity", "joint_axis"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
        assert getattr(found, name).dtype == getattr(expected, name).dtype
    assert len(found.views) == len(expected.views)
    for a, b in zip(found.views, expected.views, strict=True):
        assert (a.clip.name, a.clip.camera) == (b.clip.name, b.clip.camera)
        for name in ("uv_px", "visible", "link_id", "entity_id"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
            assert getattr(a, name).dtype == getattr(b, name).dtype
        for name in ("rgb", "depth_m", "stamp_s", "cam_from_world"):
            np.testing.assert_array_equal(getattr(a.clip, name), getattr(b.clip, name))


def test_read_returns_what_was_written(store: TakeStore, take: Take, tmp_path: Path):
    assert_equal(store.read("panels"), take)
    assert (store.names(), len(store), "panels" in store) == (["panels"], 1, True)
    assert store.infos() == {"panels": take.info}
    assert store.header("panels").frames == 13
    again = TakeStore(tmp_path / "again")  # files are the same every time
    again.write(take)
    files = [{p.relative_to(f): p.read_bytes() for p in f.rglob("*") if p.is_file()}
             for f in (store.path("panels"), again.path("panels"))]  # fmt: skip
    assert files[0] == files[1]


def test_some_views_and_frames(store: TakeStore, take: Take):
    part = store.read("panels", views=[1], frames=slice(2, 9, 3))
    assert (len(part), len(part.views)) == (3, 1)
    np.testing.assert_array_equal(part.views[0].clip.rgb, take.views[1].clip.rgb[2:9:3])
    np.testing.assert_array_equal(part.point_world, take.point_world[2:9:3])
    np.testing.assert_array_equal(part.flow_world[:-1], np.diff(take.point_world[2:9:3], axis=0))
    assert (part.flow_world[-1] == 0).all()
    assert part.info.frames_per_s == take.info.frames_per_s / 3
    assert store.read("panels", views=[]).views == ()
    view = store.read_view("panels", 1, frames=slice(-2, None))
    np.testing.assert_array_equal(view.entity_id, take.views[1].entity_id[-2:])
    np.testing.assert_array_equal(view.clip.stamp_s, take.stamp_s[-2:])
    clip = open_clip(store.path("panels"), view=1)
    np.testing.assert_array_equal(clip.depth_m, take.views[1].clip.depth_m)
    for frames in (slice(50, 60), slice(None, None, -1)):
        with pytest.raises(TakeError, match="frames 0 to 12"):
            store.read("panels", frames=frames)
    with pytest.raises(TakeError, match="no view 2; it has views 0 to 1"):
        open_clip(store.path("panels"), view=2)


def test_depth_keeps_a_tenth_of_a_millimetre_and_says_missing_beyond_its_range(tmp_path: Path, take: Take):
    depth_m = np.array(take.views[0].clip.depth_m)
    depth_m[0, 0, :5] = [np.nan, np.inf, -1.0, 7.0, 1.23456]
    store = TakeStore(tmp_path)
    views = [replace(take.views[0], clip=replace(take.views[0].clip, depth_m=depth)) for depth in (depth_m, None)]
    store.write(replace(take, views=tuple(views)))
    found = store.read_clip("panels").depth_m
    assert found is not None
    np.testing.assert_array_equal(found[0, 0, :4], 0)
    assert abs(found[0, 0, 4] - 1.23456) <= 0.5e-4 + 1e-7
    assert store.read_clip("panels", 1).depth_m is None


def test_hash_follows_arrays_and_description_but_not_provenance(store: TakeStore, take: Take):
    store.verify("panels")
    assert store.data_hash("panels") == hash_take(take)
    assert hash_take(replace(take, info=replace(take.info, provenance={"commit": "abc"}))) == hash_take(take)
    others = [replace(take, info=replace(take.info, **change)) for change in ({"seed": 9}, {"suite": "occlusion"})]
    others.append(replace(take, point_world=take.point_world + np.float32(1e-6)))
    assert len({hash_take(other) for other in (take, *others)}) == 4


def test_takes_from_before_there_were_suites_read_and_keep_their_digest(store: TakeStore, take: Take):
    fields = json.loads((store.path("panels") / "zarr.json").read_text())["attributes"]["info"]
    del fields["suite"]
    edit_header(store.path("panels"), info=fields)
    assert store.header("panels").info == take.info
    described = {name: value for name, value in fields.items() if name != "provenance"} | {"cameras": []}
    expected = hashlib.sha256(json.dumps(described, sort_keys=True).encode()).hexdigest()
    assert TakeHash(take.info, ()).hexdigest() == expected


@pytest.mark.parametrize("name", ["", ".hidden", "a/b", "..\\b"])
def test_names_stay_inside_the_folder(store: TakeStore, take: Take, name: str):
    with pytest.raises(TakeError, match="name"):
        store.write(replace(take, info=replace(take.info, name=name)))


def test_what_is_not_written(store: TakeStore, take: Take, tmp_path: Path):
    with pytest.raises(TakeError, match="written once"):
        store.write(take)
    two_joints = replace(take.info, joints=take.info.joints[:2])
    empty = TakeStore(tmp_path / "empty")
    with pytest.raises(InputError, match="joint_position has shape"):
        empty.write(replace(take, info=two_joints))
    with pytest.raises(InputError, match="time stamps"):
        empty.write(replace(take, stamp_s=take.stamp_s + 1))
    assert not empty.exists()


def test_missing_take(tmp_path: Path):
    assert TakeStore(tmp_path / "nowhere").names() == []
    with pytest.raises(TakeError, match="no folder"):
        TakeStore(tmp_path).read("panels")
    with pytest.raises(TakeError, match="expected a folder"):
        open_clip(tmp_path)
    (tmp_path / "panels.zarr").write_bytes(b"not a folder")
    assert TakeStore(tmp_path).names() == []
    with pytest.raises(TakeError):
        TakeStore(tmp_path).read("panels")


def edit_header(folder: Path, **attributes: object) -> None:
    path = folder / "zarr.json"
    header = json.loads(path.read_text())
    header["attributes"] |= attributes
    path.write_text(json.dumps(header))


def edit_info(folder: Path, **fields: object) -> None:
    edit_header(folder, info=json.loads((folder / "zarr.json").read_text())["attributes"]["info"] | fields)


def grow(folder: Path, array: str, frames: int) -> None:
    path = folder / array / "zarr.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"shape": [frames]}))


def tear_array(folder: Path) -> None:
    for path in (folder / "view_0" / "rgb").rglob("*"):
        if path.is_file():
            path.unlink()


def tear_shard(folder: Path) -> None:
    path = folder / "view_1" / "depth" / "c" / "0" / "0" / "0"
    path.write_bytes(path.read_bytes()[:-7])


TORN = {
    "missing array": (tear_array, "torn.*rgb.*missing"),
    "truncated shard": (tear_shard, "torn.*depth.*bytes, expected"),
    "no header": (lambda folder: (folder / "zarr.json").unlink(), "torn or not a take"),
    "half a header": (lambda folder: (folder / "zarr.json").write_text('{"attributes": {"form'), "cannot be read"),
    "other version": (lambda folder: edit_header(folder, version=99), "format version 99, expected 1"),
    "other group": (lambda folder: edit_header(folder, format="x"), "not a take"),
    "damaged header": (lambda folder: edit_header(folder, info={}), "cannot be read"),
    "another name": (lambda folder: edit_info(folder, name="../x"), "of another name"),
    "no frame rate": (lambda folder: edit_info(folder, frames_per_s=0), "to be positive"),
    "files elsewhere": (lambda folder: edit_header(folder, files={"../../x": 1}), "outside of the take"),
    "a number for a text": (lambda folder: edit_info(folder, category=3), "info.category: expected a text"),
    "a pipe": (lambda folder: ((folder / "zarr.json").unlink(), os.mkfifo(folder / "zarr.json")), "as a file"),
    "an array without end": (lambda folder: grow(folder, "stamp_s", 2**40), "stamp_s/zarr.json has"),
}


def test_nothing_is_allocated_that_the_files_cannot_hold(store: TakeStore):
    folder = store.path("panels")
    grow(folder, "stamp_s", 2**40)
    header = json.loads((folder / "zarr.json").read_text())["attributes"]
    files = header["files"] | {"stamp_s/zarr.json": (folder / "stamp_s" / "zarr.json").stat().st_size}
    edit_header(folder, files=files, frames=2**40)
    with pytest.raises(TakeError, match="stamp_s has shape"):
        store.read_small_arrays("panels")


@pytest.mark.parametrize("how", TORN)
def test_torn_takes_are_noticed(store: TakeStore, how: str):
    tear, message = TORN[how]
    tear(store.path("panels"))
    with pytest.raises(TakeError, match=message) as caught:
        store.read("panels")
    assert "panels" in str(caught.value)
    assert "panels" not in store
    assert store.names() == []
    assert store.infos() == {}
    assert store.problems() == {"panels": str(caught.value)}
    with pytest.raises(TakeError):
        store.write(make_take(frames=2, size=(8, 8), name="panels"))


@pytest.mark.parametrize("array", ["view_0/rgb", "point_world"])
def test_flipped_bits_are_noticed(store: TakeStore, array: str):
    path = max((store.path("panels") / array / "c").rglob("*"), key=lambda p: p.is_file())
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(TakeError, match="an array: cannot be read"):
        store.read("panels")


def test_a_failing_write_leaves_nothing(tmp_path: Path, take: Take, monkeypatch: pytest.MonkeyPatch):
    def full_disk(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(OSError, match="No space"):
        TakeStore(tmp_path).write(take)
    assert list(tmp_path.iterdir()) == []


def test_leftovers_of_dead_writers_are_removed_and_those_of_living_ones_kept(store: TakeStore, take: Take):
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    leftovers = [store.root / f".tmp-{socket.gethostname()}-{pid}-00000000" for pid in (dead.pid, os.getppid())]
    for folder in leftovers:
        folder.mkdir()
    assert store.names() == ["panels"]
    store.write(replace(take, info=replace(take.info, name="another")))
    assert [folder.exists() for folder in leftovers] == [False, True]


WRITER = """
import sys
from dataclasses import replace
from quest.data.store import TakeStore
from tests.synthetic import make_take
take = make_take(frames=20, size=(96, 96))
store = TakeStore(sys.argv[1])
for i in range(10_000):
    store.write(replace(take, info=replace(take.info, name=f"{sys.argv[2]}-{i}")))
"""


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="needs SIGKILL")
def test_a_killed_writer_leaves_whole_takes_or_nothing(tmp_path: Path, take: Take):
    root = Path(__file__).resolve().parents[2]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(root), str(root / "src")])}
    store = TakeStore(tmp_path)
    rng = random.Random(0)
    for run in range(3):
        writer = subprocess.Popen([sys.executable, "-c", WRITER, str(tmp_path), str(run)], env=environment)
        deadline = time.monotonic() + 60
        while not list(tmp_path.glob(f"{run}-*.zarr")) and time.monotonic() < deadline and writer.poll() is None:
            time.sleep(0.005)
        time.sleep(rng.uniform(0, 0.15))
        writer.send_signal(signal.SIGKILL)
        assert writer.wait() == -signal.SIGKILL
        assert store.problems() == {}
    names = store.names()
    assert {name[0] for name in names} == {"0", "1", "2"}
    for name in names:
        store.verify(name)
    store.write(take)
    assert all(path.suffix == ".zarr" for path in tmp_path.iterdir())
