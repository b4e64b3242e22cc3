"""The contents of a Rerun recording of tracks, read back from the file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from quest.errors import ConfigError, MissingExtraError
from quest.extras import is_installed
from quest.tracks import Joints, Tracks
from quest.types import Clip
from quest.viz import rerun_tracks
from quest.viz.rerun_tracks import check_viewer, save_tracks
from tests.synthetic import make_take
from tests.viz.test_rerun_log import Recording

needs_rerun = pytest.mark.skipif(not is_installed("rerun"), reason="the viz extra is not installed")


@pytest.fixture(scope="module")
def clip() -> Clip:
    return make_take(frames=4, views=1, size=(24, 20), name="panels").views[0].clip


@pytest.fixture(scope="module")
def tracks() -> Tracks:
    """Two entities: one from the second frame on and with a joint, one that is never lifted."""
    uv = np.tile(np.array([5.0, 6.0], np.float32), (4, 2, 1))
    uv[0, 0] = np.nan
    point = np.tile(np.arange(4, dtype=np.float32)[:, None, None] / 10, (1, 2, 3))
    point[0, 0] = point[:, 1] = np.nan
    joints = Joints.unknown(4, 2)
    joints.axis[0], joints.origin[0], joints.q[1:, 0] = (0, 0, 1), (1, 2, 3), (0, 0.1, 0.2)
    joints.q_min_seen[0], joints.q_max_seen[0] = 0, 0.2
    return Tracks(
        names=("left/knob", "rim"),
        labels=("knob", "rim"),
        uv_px=uv,
        point_world=point,
        confidence=np.tile(np.array([0.5, 0.25], np.float32), (4, 1)),
        visible=np.ones((4, 2), bool),
        state=np.full((4, 2), "tracking"),
        stamp_s=np.arange(4) / 30.0,
        joints=replace(joints, kind=("revolute", "unknown")),
    )


@needs_rerun
def test_tracks_are_there(clip: Clip, tracks: Tracks, tmp_path: Path):
    path = tmp_path / "deep" / "tracks.rrd"
    save_tracks(clip, tracks, path)
    assert [file.name for file in path.parent.iterdir()] == ["tracks.rrd"]
    recording = Recording(path)
    assert len(recording.blueprints) == 1
    found, name = recording.entities(), "left\\/knob"
    assert {"/world/camera/image/rgb", "/world/camera/image/depth"} <= found
    assert {f"/world/joints/{name}/{part}" for part in ("axis", "path")} <= found
    nowhere = ("/world/joints/rim", "/joints/rim", "/world/entities/rim", "/world/trails/rim")
    assert not [entity for entity in found if entity.startswith(nowhere)]
    points = recording.values(f"/world/entities/{name}", "Points3D:positions")
    np.testing.assert_allclose(np.squeeze(points), tracks.point_world[1:, 0])
    trails = recording.values(f"/world/trails/{name}", "LineStrips3D:strips")
    assert [len(trail[0]) for trail in trails] == [1, 2, 3]
    assert recording.values(f"/world/camera/image/entities/{name}", "frame") == [1, 2, 3]
    assert np.squeeze(recording.values("/confidence/rim", "Scalars:scalars")).tolist() == [0.25] * 4
    arrow = [recording.values(f"/world/joints/{name}/axis", f"Arrows3D:{end}") for end in ("origins", "vectors")]
    start, along = (np.squeeze(end) for end in arrow)
    np.testing.assert_allclose(start[:2], [1, 2], atol=1e-6)
    np.testing.assert_allclose(along[:2], 0, atol=1e-6)
    np.testing.assert_allclose(start[2] + along[2] / 2, 0.2, atol=1e-6)  # level with the entity
    arc = recording.values(f"/world/joints/{name}/path", "LineStrips3D:strips")[0]
    assert len(arc) == 3  # and the arms to both of its ends
    coordinate = recording.values(f"/joints/{name}", "Scalars:scalars")
    np.testing.assert_allclose(np.squeeze(coordinate), np.degrees([np.nan, 0, 0.1, 0.2]), atol=1e-5)


@needs_rerun
def test_colours_alone(clip: Clip, tracks: Tracks, tmp_path: Path):
    nowhere = replace(tracks, point_world=np.full_like(tracks.point_world, np.nan), joints=None)
    save_tracks(replace(clip, depth_m=None), nowhere, tmp_path / "tracks.rrd")
    found = Recording(tmp_path / "tracks.rrd").entities()
    assert "/world/camera/image/rgb" in found
    assert not [entity for entity in found if "depth" in entity or "trails" in entity]


@needs_rerun
def test_no_screen(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("sys.platform", "linux")
    for variable in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(variable, raising=False)
    check_viewer(on_screen=False)
    with pytest.raises(ConfigError, match="--rrd FILE"):
        check_viewer(on_screen=True)


def test_without_the_extra(monkeypatch: pytest.MonkeyPatch):
    def missing(module: str) -> None:
        raise MissingExtraError(f"{module} is not installed")

    monkeypatch.setattr(rerun_tracks, "require", missing)
    with pytest.raises(MissingExtraError, match="rerun is not installed"):
        check_viewer(on_screen=False)
