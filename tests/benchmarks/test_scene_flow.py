"""EPE3D against a plain loop."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.scene_flow import ANSWERS, flow_errors, flow_rows, records_of
from quest.errors import ConfigError
from quest.paper.flow import with_flow_head
from quest.train.feature_cache import CachedView
from tests.paper.tiny import make_paper
from tests.train.prepared import CPU, prepare

SUBJECT = {"take": "t", "view": "t-v0", "part": "validation", "source": "procedural", "suite": "plain", "level": 1}


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> list[CachedView]:
    return prepare(tmp_path_factory.mktemp("flow"), make_paper(), (0, 1))


@pytest.mark.parametrize("stride", [1, 3])
def test_zero_flow_is_how_far_things_go(views: list[CachedView], stride: int):
    """A new head says zero flow; both are the length of the true displacement."""
    network, view = with_flow_head(make_paper()).eval(), views[0]
    flow = flow_errors(network, view, stride=stride, device=CPU, batch=5)
    assert flow is not None
    step = np.linalg.norm(view.point_world[stride:] - view.point_world[:-stride], axis=-1) / view.half_diagonal_m
    assert flow.error["zero"] == pytest.approx(step, abs=1e-4)
    assert flow.error["head"] == pytest.approx(step, abs=1e-4)
    assert set(flow.error) == set(ANSWERS)


def test_lifting_at_the_truth_knows_even_motion(views: list[CachedView]):
    """Where an entity does not move and is seen, depth at its true pixel says so."""
    view = views[0]
    flow = flow_errors(with_flow_head(make_paper()).eval(), view, stride=1, device=CPU)
    assert flow is not None
    hidden = ~(view.visible[:-1] & np.vstack((view.visible[:1], view.visible[:-2])))
    assert (flow.error["lifted-truth"][hidden] == flow.error["zero"][hidden]).all()


def test_nothing_to_ask_for(views: list[CachedView]):
    view = replace(views[0], visible=np.zeros_like(views[0].visible))
    network = with_flow_head(make_paper()).eval()
    assert flow_errors(network, view, stride=1, device=torch.device("cpu")) is None
    assert flow_errors(network, views[0], stride=len(views[0]), device=CPU) is None
    with pytest.raises(ConfigError, match="stride"):
        flow_errors(network, views[0], stride=0, device=CPU)


def test_rows_are_pooled_over_what_is_judged(views: list[CachedView], tmp_path: Path):
    network = with_flow_head(make_paper()).eval()
    records, errors = [], []
    for view in views:
        flow = flow_errors(network, view, stride=1, device=CPU)
        assert flow is not None
        records += records_of(flow, object_id=view.object_id, stride=1, **SUBJECT)
        errors.append(flow.error["zero"][:, flow.scored].ravel())
    rows = {row["reading"]: row for row in flow_rows(records, resamples=50, seed=0)}
    assert rows["all"]["epe"]["zero"].mean == pytest.approx(np.concatenate(errors).mean())
    assert rows["all"]["objects"] == len({view.object_id for view in views})
    assert rows["all"]["epe"]["zero"].low is not None
    assert rows["moving"]["epe"]["zero"].mean >= rows["moved"]["epe"]["zero"].mean
    assert rows["moved"]["entities"] <= rows["all"]["entities"] == len(records)
