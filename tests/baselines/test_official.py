"""Rivals by their authors' code, for which stubs stand: what they are given, what becomes of it, refusals."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from quest.baselines import TRACKERS, line_up
from quest.baselines.cotracker import CoTracker
from quest.baselines.official import Official, import_code
from quest.baselines.raft import filled
from quest.data.cut import cut_clip
from quest.errors import ConfigError, InputError, WeightsError
from quest.types import Camera, Clip, Query, State
from tests.baselines.stubs import FILES, HIDDEN, MOVE_PX, SIZE, write_rivals

NAMES = [name for name, entry in TRACKERS.items() if entry.official]
INSTALLED = ("torchvision", "lietorch")
CHAINED = ("raft-official", "raft-3d-official")
QUERIES = [Query.point(1, 30.25, 40.0, name="lid"), Query.point(4, 20.0, 60.5)]


@pytest.fixture(scope="module")
def rivals(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_rivals(tmp_path_factory.mktemp("rivals"), NAMES)


@pytest.fixture
def installed(rivals: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """What RAFT-3D needs; in the end the right torchvision again, if there is one."""
    monkeypatch.syspath_prepend(rivals / "installed")
    ours = {name: sys.modules.pop(name) for name in list(sys.modules) if name.partition(".")[0] in INSTALLED}
    import_code.cache_clear()
    yield
    for name in [name for name in sys.modules if name.partition(".")[0] in INSTALLED]:
        del sys.modules[name]
    sys.modules.update(ours)
    import_code.cache_clear()


@pytest.fixture
def clip() -> Clip:
    """A wall of noise at 2 m, with holes in its depth."""
    width, height = SIZE
    rgb = np.random.default_rng(0).integers(0, 256, (20, height, width, 3), dtype=np.uint8)
    depth_m = np.full((20, height, width), 2.0, np.float32)
    depth_m[:, ::7] = 0
    camera = Camera(100.0, 100.0, width / 2, height / 2, width, height)
    return Clip("wall", camera, rgb, depth_m, np.arange(20) / 30, np.tile(np.eye(4), (20, 1, 1)))


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize("name", NAMES)
def test_points_come_and_go_in_source_pixels(rivals: Path, clip: Clip, name: str) -> None:
    (tracker,) = line_up([name], weights="none", rivals=rivals)
    tracks = tracker.track(clip, QUERIES)
    assert tracks.names == ("lid", "point-1")
    for k, query in enumerate(QUERIES):
        age = np.arange(len(clip) - query.frame)[:, None]
        expected = np.asarray(query.uv_px) + age * MOVE_PX
        here = ((expected >= 0) & (expected <= SIZE)).all(axis=-1) if name in CHAINED else np.ones(len(age), bool)
        np.testing.assert_allclose(tracks.uv_px[query.frame :, k][here], expected[here], atol=2e-3)
        assert np.isnan(tracks.uv_px[: query.frame, k]).all()
        assert not tracks.visible[: query.frame, k].any()
    hidden = np.flatnonzero(~tracks.visible[1:12, 0]) + 1
    assert hidden.tolist() == ([] if name in CHAINED else [1 + HIDDEN])
    if len(hidden):
        assert tracks.state[hidden[0], 0] == State.LOST
        np.testing.assert_array_equal(tracks.point_world[hidden[0], 0], tracks.point_world[hidden[0] - 1, 0])
    shown = np.flatnonzero(tracks.visible[:12, 0])
    x_m = (tracks.uv_px[shown, 0, 0] - SIZE[0] / 2) / 100 * 2
    np.testing.assert_allclose(tracks.point_world[shown, 0, 0], x_m, atol=1e-4)
    assert len(getattr(tracker, "rival_hash", "")) == 64
    assert tracker.track(clip, []).uv_px.shape == (20, 0, 2)


@pytest.mark.usefixtures("installed")
def test_clips_of_any_length(rivals: Path, clip: Clip) -> None:
    (tracker,) = line_up(["cotracker3-online-official"], weights="none", rivals=rivals)
    for frames in (1, 8, 9, 16, 17):
        short = cut_clip(dataclasses.replace(clip, depth_m=None), slice(frames))
        tracks = tracker.track(short, [Query.point(0, 10.0, 60.0)])
        np.testing.assert_allclose(tracks.uv_px[-1, 0], np.add((10, 60), np.multiply(frames - 1, MOVE_PX)), atol=1e-4)
        assert any("without depth" in flag for flag in tracks.frame_flags)
    assert isinstance(tracker, CoTracker)
    assert tracker.predictor.queries.tolist() == [[[0, 9.5, 59.5]]]  # their pixel centres lie at integers


@pytest.mark.usefixtures("installed")
def test_settings_of_the_published_checkpoints(rivals: Path) -> None:
    made = {t.name: t.network.parts for t in line_up(NAMES, weights="none", rivals=rivals) if isinstance(t, Official)}
    for name, boots, causal in (("tapir", 0, False), ("bootstapir", 1, False), ("bootstapir-online", 1, True)):
        own = {"pyramid_level": boots, "extra_convs": bool(boots), "use_casual_conv": causal}
        assert made[f"{name}-official"] == own


def test_official_code_hides_nothing(rivals: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ours = type(sys)("utils")
    monkeypatch.setitem(sys.modules, "utils", ours)
    path = list(sys.path)
    import_code.cache_clear()
    code = import_code(rivals / "RAFT" / "core", "raft")
    assert code.RAFT.__module__ == "raft"
    assert sys.modules["utils"] is ours
    assert "raft" not in sys.modules
    assert sys.path == path
    state = torch.random.get_rng_state()
    import_code(rivals / "co-tracker", "cotracker.predictor")  # which seeds
    assert torch.equal(torch.random.get_rng_state(), state)


@pytest.mark.usefixtures("installed")
def test_raft_3d_sees_the_nearest_depth_and_needs_some(rivals: Path, clip: Clip) -> None:
    assert filled(np.array([[0, 1, 0, 0, 3]], np.float32)).tolist() == [[1, 1, 1, 3, 3]]
    (tracker,) = line_up(["raft-3d-official"], weights="none", rivals=rivals)
    assert clip.depth_m is not None
    clip.depth_m[6] = 0
    tracks = tracker.track(clip, [Query.point(4, 30.25, 40.0)])
    assert tracks.visible[4:10, 0].tolist() == [True, True, False, False, True, True]
    with pytest.raises(InputError, match="raft-3d-official"):
        tracker.track(dataclasses.replace(clip, depth_m=None), QUERIES)


def test_what_is_missing_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torchvision.models", None)
    for name in NAMES:
        with pytest.raises(ConfigError, match="--rivals"):
            line_up([name], weights="none")
        with pytest.raises(ConfigError, match="torchvision" if name == "raft-3d-official" else "clone"):
            line_up([name], weights="none", rivals=tmp_path)
    file = tmp_path / "co-tracker/cotracker/predictor.py"
    file.parent.mkdir(parents=True)
    file.write_text("import no_such_package\n" + FILES["co-tracker/cotracker/predictor.py"])
    with pytest.raises(ConfigError, match="no_such_package"):
        line_up(["cotracker3-official"], weights="none", rivals=tmp_path)


def test_weights_of_something_else(tmp_path: Path) -> None:
    write_rivals(tmp_path, ["raft-official"])
    path = tmp_path / "raft-official.safetensors"
    tensors = load_file(path)
    for changed, match in (
        ({"layer.weight": tensors["layer.weight"]}, r"1 missing \(layer.bias\)"),
        (tensors | {f"more.{i}": torch.zeros(1) for i in range(7)}, r"7 unexpected \(more.0, more.1"),
        (tensors | {"layer.bias": torch.zeros(9)}, "other shapes"),
    ):
        save_file(changed, path)
        with pytest.raises(WeightsError, match=match):
            line_up(["raft-official"], weights="none", rivals=tmp_path)
    path.write_bytes(b"PK no safetensors")
    with pytest.raises(WeightsError, match="safetensors"):
        line_up(["raft-official"], weights="none", rivals=tmp_path)
    path.unlink()
    with pytest.raises(WeightsError, match="published checkpoint"):
        line_up(["raft-official"], weights="none", rivals=tmp_path)
