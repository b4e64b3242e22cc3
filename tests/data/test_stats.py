"""Statistics of a store against the takes that went into it."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from quest.data.stats import Spread, store_stats
from quest.data.store import TakeStore
from quest.types import Take
from tests.synthetic import make_take


@pytest.fixture(scope="module")
def takes() -> list[Take]:
    first = make_take(frames=24, views=2, entities=3, hinges=True, name="a")
    second = make_take(frames=12, views=1, entities=2, seed=1, name="b")
    view = second.views[0]
    turn = np.tile(np.eye(4), (12, 1, 1))
    turn[:, 0, 3] = np.linspace(0, 1e-6, 12)
    assert view.clip.depth_m is not None
    depth = view.clip.depth_m.copy()
    depth[:, :32] = 0
    moving = replace(view, clip=replace(view.clip, depth_m=depth, cam_from_world=turn @ view.clip.cam_from_world))
    info = replace(second.info, category="Doors", suite="noise", provenance={"sensor": {"depth": {"step_px": 0.1}}})
    return [first, replace(second, info=info, views=(moving,))]


def test_numbers(takes: list[Take], tmp_path: Path):
    store = TakeStore(tmp_path)
    for take in takes:
        store.write(take)
    (tmp_path / "torn.zarr").mkdir()
    told = []
    found = store_stats(store, report=lambda done, of: told.append((done, of)))
    assert told == [(1, 2), (2, 2)]
    assert (found.takes, found.unreadable, found.objects, found.views, found.frames) == (2, 1, 2, 3, 2 * 24 + 12)
    assert found.hours == pytest.approx(60 / 30 / 3600)
    assert found.categories == {"Panels": 1, "Doors": 1}
    assert found.suites == {"standard": 1, "noise": 1}
    assert found.labels == {"handle": 2, "knob": 2, "rim": 1, "hinge": 3}
    assert found.image_px == {"64 x 64": 2}
    assert (found.moving_cameras, found.with_depth_sensor) == (1, 1)
    seen = np.concatenate([view.visible[:, take.tracked].ravel() for take in takes for view in take.views])
    assert found.visible_share == pytest.approx(seen.mean())
    assert set(found.visible_share_by_label) == {"handle", "knob", "rim"}
    reach = [np.linalg.norm(t.point_world - t.point_world[:1], axis=-1).max(axis=0)[t.tracked] for t in takes]
    assert found.motion_m.n == 5
    assert found.motion_m.most == pytest.approx(max(map(np.max, reach)))
    assert found.moved_share == pytest.approx(np.mean(np.concatenate([t.moved[t.tracked] for t in takes])))
    assert found.diagonal_m.least == pytest.approx(2 * min(take.info.half_diagonal_m for take in takes))
    assert 0.5 < found.distance_m.least < found.distance_m.most < 5
    assert found.depth_missing_share == pytest.approx(0.5 / 3)
    assert 0 < found.depth_missing_share_on_object < 0.5
    assert found.stored_bytes == sum(f.stat().st_size for f in tmp_path.rglob("*/*") if f.is_file()) - sum(
        (store.path(name) / "zarr.json").stat().st_size for name in "ab"
    )
    assert set(asdict(found)["motion"]) == {"n", "least", "low", "median", "high", "most"}


def test_nothing(tmp_path: Path):
    found = store_stats(TakeStore(tmp_path))
    assert (found.takes, found.frames, found.motion.n) == (0, 0, 0)
    assert math.isnan(found.visible_share)
    assert math.isnan(found.depth_missing_share)
    assert math.isnan(found.motion.median)
    spread = Spread.of([np.arange(11.0), 100.0])
    assert (spread.n, spread.least, spread.median, spread.most) == (12, 0, 5.5, 100)
