"""What Rerun recordings of takes and of tracks hold, read back from the file."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from quest.data.store import TakeStore
from quest.errors import ConfigError, MissingExtraError
from quest.extras import is_installed
from quest.types import Joints, Take, Tracks
from quest.viz.rerun_log import check_viewer, save_rrd, save_tracks
from tests.synthetic import make_take

needs_rerun = pytest.mark.skipif(not is_installed("rerun"), reason="the viz extra is not installed")


@pytest.fixture(scope="module")
def take() -> Take:
    """Three frames of two views; the second camera moves and has no depth."""
    take = make_take(frames=3, views=2, size=(24, 20), hinges=True, name="panels")
    pose = take.views[1].clip.cam_from_world.copy()
    pose[:, 2, 3] += [0, 0.1, 0.2]
    moving = replace(take.views[1], clip=replace(take.views[1].clip, cam_from_world=pose, depth_m=None))
    return replace(take, views=(take.views[0], moving))


@pytest.fixture(scope="module")
def tracks() -> Tracks:
    """Two entities: one from the second frame on and with a joint, one that is never lifted."""
    uv = np.tile(np.array([5.0, 6.0], np.float32), (3, 2, 1))
    uv[0, 0] = np.nan
    point = np.tile(np.arange(3, dtype=np.float32)[:, None, None] / 10, (1, 2, 3))
    point[0, 0] = point[:, 1] = np.nan
    joints = Joints.unknown(3, 2)
    joints.axis[0], joints.origin[0], joints.q[1:, 0] = (0, 0, 1), (1, 2, 3), (0, 0.1)
    joints.q_min_seen[0], joints.q_max_seen[0] = 0, 0.1
    return Tracks(
        names=("left/knob", "rim"), labels=("knob", "rim"), uv_px=uv, point_world=point,
        confidence=np.tile(np.array([0.5, 0.25], np.float32), (3, 1)), visible=np.ones((3, 2), bool),
        state=np.full((3, 2), "tracking"), stamp_s=np.arange(3) / 30.0,
        joints=replace(joints, kind=("revolute", "unknown")),
    )  # fmt: skip


class Recording:
    """The columns of a recording by entity and component, one value per time."""

    def __init__(self, path: Path) -> None:
        import rerun.chunk

        reader = rerun.chunk.RrdReader(path)
        self.blueprints = reader.blueprints()
        self.timelines: dict[str, set[str]] = {}
        self._values: dict[tuple[str, str], list] = {}
        for chunk in reader.stream().to_chunks():
            self.timelines.setdefault(chunk.entity_path, set()).update(chunk.timeline_names)
            batch = chunk.to_record_batch()
            order = np.argsort(batch["frame"].to_numpy()) if "frame" in batch.schema.names else range(batch.num_rows)
            for name in set(batch.schema.names) - {"time"}:  # nanoseconds, which Python's durations do not have
                rows = batch[name].to_pylist()
                self._values.setdefault((chunk.entity_path, name), []).extend(rows[i] for i in order)

    def values(self, entity: str, component: str) -> list:
        return [value for value in self._values[entity, component] if value is not None]

    def array(self, entity: str, component: str) -> np.ndarray:
        return np.squeeze(self.values(entity, component))


@needs_rerun
def test_a_take(take: Take, tmp_path: Path):
    path = tmp_path / "deep" / "take.rrd"
    save_rrd(take, path)
    assert [file.name for file in path.parent.iterdir()] == ["take.rrd"]
    recording = Recording(path)
    assert len(recording.blueprints) == 1
    assert recording.timelines["/world/view_0/image/rgb"] == {"frame", "time"}
    expected = set[str]()
    for entity in take.info.entities:
        name = entity.name.replace("/", "\\/")
        expected |= {f"/world/entities/{name}", f"/world/trails/{name}"}
    for joint in take.info.joints:
        expected |= {f"/joints/{joint.name}", f"/world/joints/{joint.name}"}
    for v in range(2):
        image = f"/world/view_{v}/image"
        expected |= {f"/world/view_{v}", image, f"{image}/rgb", f"{image}/links", f"{image}/entities/seen"}
    assert expected | {"/world/view_0/image/depth"} <= recording.timelines.keys()
    assert "/world/view_1/image/depth" not in recording.timelines

    name = take.info.entities[1].name.replace("/", "\\/")
    assert np.allclose(recording.array(f"/world/entities/{name}", "Points3D:positions"), take.point_world[:, 1])
    trails = recording.values(f"/world/trails/{name}", "LineStrips3D:strips")
    assert np.allclose(trails[2][0], take.point_world[:, 1])
    curve = recording.array(f"/joints/{take.info.joints[1].name}", "Scalars:scalars")
    assert np.allclose(curve, take.joint_position[:, 1])
    masks = recording.values("/world/view_0/image/links", "SegmentationImage:buffer")
    assert np.array_equal(np.reshape(masks, take.views[0].link_id.shape), take.views[0].link_id)
    seen = recording.values("/world/view_0/image/entities/seen", "Points2D:positions")
    assert [len(points) for points in seen] == take.views[0].visible.sum(axis=1).tolist()

    assert len(recording.values("/world/view_0", "Transform3D:translation")) == 1  # at rest
    poses = np.linalg.inv(take.views[1].clip.cam_from_world)
    assert np.allclose(recording.array("/world/view_1", "Transform3D:translation"), poses[:, :3, 3], atol=1e-6)
    columns = np.reshape(recording.values("/world/view_1", "Transform3D:mat3x3")[0], (3, 3)).T  # column by column
    assert np.allclose(columns, poses[0, :3, :3], atol=1e-6)


@needs_rerun
def test_frames_that_are_left_out_are_counted(tmp_path: Path):
    """Of a thinned take, numbers are those of the whole one, and trails still reach back a second."""
    store, take = TakeStore(tmp_path / "takes"), make_take(frames=61, views=1, size=(24, 20), name="long")
    store.write(take)
    save_rrd(store.read("long", frames=slice(None, None, 10)), tmp_path / "thin.rrd", every=10)
    recording = Recording(tmp_path / "thin.rrd")
    frames = [0, 10, 20, 30, 40, 50, 60]
    assert sorted(recording.values("/world/view_0/image/rgb", "frame")) == frames
    assert recording.values(f"/joints/{take.info.joints[0].name}", "frame") == frames
    name = take.info.entities[0].name.replace("/", "\\/")
    trails = recording.values(f"/world/trails/{name}", "LineStrips3D:strips")
    assert [len(trail[0]) for trail in trails] == [1, 2, 3, 4, 4, 4, 4]


@needs_rerun
def test_tracks(take: Take, tracks: Tracks, tmp_path: Path):
    save_tracks(take.views[0].clip, tracks, tmp_path / "tracks.rrd")
    recording = Recording(tmp_path / "tracks.rrd")
    assert len(recording.blueprints) == 1
    found, name = recording.timelines.keys(), "left\\/knob"
    assert {"/world/camera/image/rgb", "/world/camera/image/depth"} <= found
    nowhere = ("/world/joints/rim", "/joints/rim", "/world/entities/rim", "/world/trails/rim")
    assert not [entity for entity in found if entity.startswith(nowhere)]
    points = recording.array(f"/world/entities/{name}", "Points3D:positions")
    np.testing.assert_allclose(points, tracks.point_world[1:, 0])
    trails = recording.values(f"/world/trails/{name}", "LineStrips3D:strips")
    assert [len(trail[0]) for trail in trails] == [1, 2]
    assert recording.values(f"/world/camera/image/entities/{name}", "frame") == [1, 2]
    assert recording.array("/confidence/rim", "Scalars:scalars").tolist() == [0.25] * 3
    assert recording.values(f"/confidence/{name}", "frame") == [1, 2]
    start, along = (recording.array(f"/world/joints/{name}/axis", f"Arrows3D:{end}") for end in ("origins", "vectors"))
    np.testing.assert_allclose(start[:2], [1, 2], atol=1e-6)
    np.testing.assert_allclose(along[:2], 0, atol=1e-6)
    np.testing.assert_allclose(start[2] + along[2] / 2, 0.15, atol=1e-6)  # level with the entity
    arc = recording.values(f"/world/joints/{name}/path", "LineStrips3D:strips")[0]
    assert len(arc) == 3  # and the arms to both of its ends
    coordinate = recording.array(f"/joints/{name}", "Scalars:scalars")
    np.testing.assert_allclose(coordinate, np.degrees([np.nan, 0, 0.1]), atol=1e-5)

    clip = take.views[0].clip
    assert clip.depth_m is not None
    cloud = np.array(recording.values("/world/points", "Points3D:positions")[1])
    rotation, moved = clip.cam_from_world[1, :3, :3], clip.cam_from_world[1, :3, 3]
    x, y, z = (cloud @ rotation.T + moved).T
    v, u = np.nonzero(clip.depth_m[1] > 0)
    np.testing.assert_allclose(z, clip.depth_m[1, v, u], rtol=1e-5)
    camera = clip.camera
    np.testing.assert_allclose(camera.fx * x / z + camera.cx, u + 0.5, atol=1e-3)
    np.testing.assert_allclose(camera.fy * y / z + camera.cy, v + 0.5, atol=1e-3)

    flat = replace(tracks, point_world=np.full_like(tracks.point_world, np.nan), joints=None)
    save_tracks(replace(take.views[0].clip, depth_m=None), flat, tmp_path / "flat.rrd")
    found = Recording(tmp_path / "flat.rrd").timelines.keys()
    assert "/world/camera/image/rgb" in found
    assert not [entity for entity in found if "depth" in entity or "trails" in entity]


@needs_rerun
def test_no_screen(take: Take, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("sys.platform", "linux")
    for variable in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(variable, raising=False)
    check_viewer(on_screen=False)
    with pytest.raises(ConfigError, match=r"no screen.*--rrd FILE"):
        save_rrd(take, None)


def test_without_the_extra(take: Take, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingExtraError, match="viz"):
        save_rrd(take, tmp_path / "take.rrd")
