"""What a Rerun recording of a take holds, read back from the file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from quest.data.store import TakeStore
from quest.errors import ConfigError, MissingExtraError
from quest.extras import is_installed
from quest.types import Take
from quest.viz.rerun_log import open_viewer, save_rrd
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

    def entities(self) -> set[str]:
        return set(self.timelines)

    def values(self, entity: str, component: str) -> list:
        return [value for value in self._values[entity, component] if value is not None]


@pytest.fixture(scope="module")
def recording(take: Take, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    pytest.importorskip("rerun")
    path = tmp_path_factory.mktemp("rerun") / "deep" / "take.rrd"
    save_rrd(take, path)
    assert [file.name for file in path.parent.iterdir()] == ["take.rrd"]
    return Recording(path)


@needs_rerun
def test_everything_is_there(take: Take, recording: Recording):
    assert len(recording.blueprints) == 1
    found = recording.entities()
    for v in range(2):
        image = f"/world/view_{v}/image"
        assert {f"/world/view_{v}", image, f"{image}/rgb", f"{image}/links", f"{image}/entities/seen"} <= found
    assert "/world/view_0/image/depth" in found
    assert "/world/view_1/image/depth" not in found
    for entity in take.info.entities:
        name = entity.name.replace("/", "\\/")
        assert {f"/world/entities/{name}", f"/world/trails/{name}"} <= found
    for joint in take.info.joints:
        assert {f"/joints/{joint.name}", f"/world/joints/{joint.name}"} <= found
    assert recording.timelines["/world/view_0/image/rgb"] == {"frame", "time"}


@needs_rerun
def test_values(take: Take, recording: Recording):
    name = take.info.entities[1].name.replace("/", "\\/")
    points = recording.values(f"/world/entities/{name}", "Points3D:positions")
    assert np.allclose(np.squeeze(points), take.point_world[:, 1])
    trails = recording.values(f"/world/trails/{name}", "LineStrips3D:strips")
    assert np.allclose(trails[2][0], take.point_world[:, 1])
    curve = recording.values(f"/joints/{take.info.joints[1].name}", "Scalars:scalars")
    assert np.allclose(np.squeeze(curve), take.joint_position[:, 1])
    masks = recording.values("/world/view_0/image/links", "SegmentationImage:buffer")
    assert np.array_equal(np.reshape(masks, take.views[0].link_id.shape), take.views[0].link_id)
    seen = recording.values("/world/view_0/image/entities/seen", "Points2D:positions")
    assert [len(points) for points in seen] == take.views[0].visible.sum(axis=1).tolist()


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
def test_cameras_follow_their_poses(take: Take, recording: Recording):
    assert len(recording.values("/world/view_0", "Transform3D:translation")) == 1  # at rest
    found = recording.values("/world/view_1", "Transform3D:translation")
    centres = np.linalg.inv(take.views[1].clip.cam_from_world)[:, :3, 3]
    assert np.allclose(np.squeeze(found), centres, atol=1e-6)
    rotation = recording.values("/world/view_1", "Transform3D:mat3x3")
    columns = np.reshape(rotation[0], (3, 3)).T  # stored column by column
    assert np.allclose(columns, take.views[1].clip.cam_from_world[0, :3, :3].T, atol=1e-6)


@needs_rerun
def test_no_screen(take: Take, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    with pytest.raises(ConfigError, match=r"no screen.*--rrd"):
        open_viewer(take)


def test_without_the_extra(take: Take, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setitem(__import__("sys").modules, "rerun", None)
    with pytest.raises(MissingExtraError, match="viz"):
        save_rrd(take, tmp_path / "take.rrd")
