"""Two places of one label, one to open by and one to lift by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from quest.bench.intents import IntentAnswer, intent_pairs, intent_rows, judge_intents
from quest.types import Clip, Query, Take, Tracks
from tests.synthetic import make_take
from tests.track.clips import make_tracker


@pytest.fixture(scope="module")
def take() -> Take:
    """Two handles, the second of which is fixed, and a rim that opens."""
    take = make_take(frames=12, views=1, entities=3, seed=0)
    first, second, third = take.info.entities
    entities = (first, replace(second, label=first.label, joint=-1), third)
    point_world, link_pose = take.point_world.copy(), take.link_pose.copy()
    point_world[:, 1], link_pose[:, second.link] = point_world[0, 1], link_pose[0, second.link]
    return replace(take, info=replace(take.info, entities=entities), point_world=point_world, link_pose=link_pose)


class Perfect:
    """Answers with the truth, or with one entity for both intents."""

    name = "perfect"

    def __init__(self, take: Take, *, deaf: bool = False, answers: np.ndarray | None = None) -> None:
        self.take = take
        self.answers = answers
        self.deaf = deaf
        self.asked: list[Query] = []

    def track(self, clip: Clip, queries: Sequence[Query] | None = None) -> Tracks:
        assert queries is not None
        self.asked += queries
        which = [0 if q.intent == "open" or self.deaf else 1 for q in queries]
        begin = int(np.flatnonzero(self.take.stamp_s == clip.stamp_s[0])[0])
        answer: Any = make_tracker().track(clip, [Query.point(0, 20.0, 30.0, name=q.name) for q in queries])
        points = self.take.point_world[begin:, which] if self.answers is None else self.answers[begin:]
        return replace(answer, point_world=points.astype(np.float32))


def test_pairs_are_labels_with_both_intents(take: Take):
    assert intent_pairs(take, 0) == [(take.info.entities[0].label, 0, 1)]
    assert intent_pairs(make_take(frames=12, views=1, entities=3, seed=0), 0) == []


@pytest.mark.slow
def test_both_intents_are_asked_for_and_judged(take: Take):
    tracker: Any = Perfect(take)
    (answer,) = judge_intents(tracker, take, 0, part="validation")
    assert [(q.kind, q.label, q.intent) for q in tracker.asked] == [
        ("semantic", answer.label, "open"),
        ("semantic", answer.label, "lift"),
    ]
    assert (answer.open_acc, answer.lift_acc) == (1.0, 1.0)
    assert answer.open_ape == pytest.approx(0, abs=1e-6)
    assert answer.both
    assert answer.kept
    deaf: Any = Perfect(take, deaf=True)
    (answer,) = judge_intents(deaf, take, 0, part="validation")
    assert (answer.open_acc, answer.lift_acc) == (1.0, 0.0)
    assert not answer.both


@pytest.mark.slow
def test_a_track_beside_its_entity_may_stay_on_its_link(take: Take):
    """Half a unit beside the moving entity, on its link; then on the other link."""
    link = take.info.entities[0].link
    moving, still = take.link_pose[:, link].astype(np.float64), take.point_world[:, 1]
    beside = take.point_world[0, 0] + 0.5 * take.info.half_diagonal_m * np.array([0.0, 1.0, 0.0])
    carried = moving @ np.linalg.inv(moving[0]) @ np.append(beside, 1.0)
    gone = take.point_world[-1, 0] - take.point_world[0, 0]
    assert np.linalg.norm(gone) > 0.1 * take.info.half_diagonal_m
    for opens, kept in ((carried[:, :3], 1.0), (np.broadcast_to(beside, (12, 3)), 0.0)):
        tracker: Any = Perfect(take, answers=np.stack((opens, still), axis=1))
        (answer,) = judge_intents(tracker, take, 0, part="validation")
        assert answer.open_bound == pytest.approx(0.5)
        assert (answer.lift_bound, answer.lift_kept) == (pytest.approx(0, abs=1e-6), 1.0)
        assert (answer.open_kept >= 0.95) == bool(kept) == answer.kept
        assert not answer.both
    silent: Any = Perfect(take, answers=np.full((12, 2, 3), np.nan))
    (answer,) = judge_intents(silent, take, 0, part="validation")
    assert (answer.open_bound, answer.open_kept, answer.lift_kept) == (1.0, 0.0, 0.0)


def test_rows_are_over_objects():
    good = IntentAnswer("t", 0, "laptop-1", "test", "procedural", "rim", 0.01, 0.02, 1.0, 0.95, 0.0, 0.1, 1.0, 1.0)
    bad = replace(good, take="u", object_id="laptop-2", lift_acc=0.5, lift_ape=0.4)
    (row,) = intent_rows([good, replace(good, view=1), bad], resamples=200)
    assert (row["objects"], row["takes"], row["views"]) == (2, 2, 3)
    assert row["both"].mean == pytest.approx(2 / 3)
    assert row["lift_ape"].mean == pytest.approx((0.02 + 0.02 + 0.4) / 3)
    assert row["both"].low <= row["both"].mean
