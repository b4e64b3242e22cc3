"""The protocols with trackers whose score is known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from quest.errors import ConfigError
from quest.evaluation.protocols import assign, evaluate_point, evaluate_semantic, starts_at_rest, unscored_entities
from quest.evaluation.records import Subject
from quest.evaluation.summary import Metrics, summarise
from quest.types import Take
from tests.evaluation.fakes import Oracle
from tests.synthetic import make_take

SUBJECT = Subject("oracle", "point", "validation", "procedural", 3, "panels-0")


@pytest.fixture(scope="module")
def take() -> Take:
    return make_take(frames=40, views=2, entities=3, hinges=True)


def _metrics(records: tuple, reading: str = "all") -> Metrics:
    (row,) = [r for r in summarise(records, resamples=20, seed=0) if r.reading == reading]
    return row.metrics


def _mean(metrics: Metrics, name: str) -> float:
    value = getattr(metrics, name)
    assert value is not None
    return value.mean


def test_the_truth_scores_perfectly(take: Take) -> None:
    records = evaluate_point(Oracle(take), take, 0, SUBJECT).records
    metrics = _metrics(records)
    for name in ("ape", "ape_vis", "ape_px", "ape_2d", "median_px", "d50", "d100", "switches", "slope"):
        assert _mean(metrics, name) == 0.0, name
    assert _mean(metrics, "acc") == 1.0


def test_a_constant_offset_gives_known_numbers(take: Take) -> None:
    unit = take.info.half_diagonal_m

    def shifted(uv: np.ndarray, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return uv + np.array([3.0, 4.0]), xyz + np.array([0.0, 0.0, 0.05 * unit])

    records = evaluate_point(Oracle(take, change=shifted), take, 1, SUBJECT).records
    metrics = _metrics(records)
    assert _mean(metrics, "ape") == pytest.approx(0.05, rel=1e-4)
    assert _mean(metrics, "d100") == pytest.approx(0.05, rel=1e-4)
    assert _mean(metrics, "slope") == pytest.approx(0.0, abs=1e-4)
    assert _mean(metrics, "ape_px") == pytest.approx(5.0 * 224 / 64, rel=1e-4)  # the frames are 64 x 64
    assert _mean(metrics, "ape_2d") == pytest.approx(5.0 / 64, rel=1e-4)
    assert _mean(metrics, "median_px") == pytest.approx(17.5, rel=1e-4)
    assert _mean(metrics, "acc") == 1.0


def test_missing_answers_are_not_dropped(take: Take) -> None:
    def half_missing(uv: np.ndarray, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        uv[20:], xyz[20:] = np.nan, np.nan
        return uv, xyz

    metrics = _metrics(evaluate_point(Oracle(take, change=half_missing), take, 0, SUBJECT).records)
    assert _mean(metrics, "ape") == pytest.approx(0.5)
    assert _mean(metrics, "acc") == pytest.approx(0.5)
    assert _mean(metrics, "ape_px") == pytest.approx(0.5 * 224 * np.sqrt(2))
    assert _mean(metrics, "d100") == 1.0


def test_an_answer_on_the_neighbour_is_a_wrong_identity(take: Take) -> None:
    def neighbour(uv: np.ndarray, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.roll(uv, 1, axis=1), np.roll(xyz, 1, axis=1)

    records = evaluate_point(Oracle(take, change=neighbour), take, 0, SUBJECT).records
    metrics = _metrics(records)
    assert _mean(metrics, "acc") == 0.0
    assert _mean(metrics, "switches") == pytest.approx(1000 / 40)  # once, at the start
    assert [int(r.follows[0]) for r in records] == [2, 0, 1]


def test_point_asks_by_pixel_only_and_from_the_first_visible_frame(take: Take) -> None:
    visible = take.views[0].visible.copy()
    visible[:3, 1] = False  # shows itself in frame 3
    visible[:8, 2] = False  # too late
    hidden = _with_visible(take, visible)
    oracle = Oracle(hidden)
    records = evaluate_point(oracle, hidden, 0, SUBJECT).records
    assert [(q.frame, q.label) for q in oracle.asked] == [(0, None), (3, None)]
    assert all(label not in q.name for q in oracle.asked for label in ("handle", "knob", "rim", "front"))
    assert [(r.entity, r.first_frame) for r in records] == [(0, 0), (1, 3)]
    assert _mean(_metrics(records), "ape") == 0.0  # nothing was asked before frame 3
    assert [(u.view, u.name) for u in unscored_entities(hidden)] == [(0, "link_2/rim")]


def test_no_visible_entity_gives_no_records(take: Take) -> None:
    blind = _with_visible(take, np.zeros_like(take.views[0].visible))
    oracle = Oracle(blind, slots=(0, 1))
    assert evaluate_point(oracle, blind, 0, SUBJECT).records == ()
    outcome = evaluate_semantic(oracle, blind, 0, SUBJECT)
    assert outcome.records == ()
    assert outcome.discovery is not None
    assert (outcome.discovery.slots, outcome.discovery.matched) == (2, 0)
    assert summarise((), (outcome.discovery,), resamples=5, seed=0) == ()


def test_hinges_are_neither_scored_nor_confusable(take: Take) -> None:
    assert {r.entity for r in evaluate_point(Oracle(take), take, 0, SUBJECT).records} == {0, 1, 2}

    def on_the_hinge(uv: np.ndarray, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return uv, take.point_world[:, 3:6].copy()

    records = evaluate_point(Oracle(take, change=on_the_hinge), take, 0, SUBJECT).records
    assert all((r.follows < 3).all() for r in records)


def test_a_tracker_must_answer_every_query(take: Take) -> None:
    class Lazy(Oracle):
        def track(self, clip, queries=None):
            return super().track(clip, queries).select([0])

    with pytest.raises(ConfigError, match="expected answers"):
        evaluate_point(Lazy(take), take, 0, SUBJECT)


def test_semantic_truth_scores_perfectly(take: Take) -> None:
    outcome = evaluate_semantic(Oracle(take, slots=(2, 0, 1)), take, 0, SUBJECT)
    assert [r.found for r in outcome.records] == [True] * 3
    assert _mean(_metrics(outcome.records), "ape") == 0.0
    assert outcome.discovery is not None
    assert (outcome.discovery.slots, outcome.discovery.matched) == (3, 3)


def test_semantic_undiscovered_and_unsure_and_mislabelled_are_missing(take: Take) -> None:
    semantic = dataclasses.replace(SUBJECT, protocol="semantic")
    oracle = Oracle(
        take, slots=(0, 1, 2, 0), labels=("handle", "rim", "rim", "handle"), confidence=(0.9, 0.9, 0.4, 0.6)
    )
    outcome = evaluate_semantic(oracle, take, 0, semantic)
    assert [r.found for r in outcome.records] == [True, False, False]  # 1 has the wrong label, 2 is unsure
    assert [float(r.distance.mean()) for r in outcome.records] == [0.0, 1.0, 1.0]
    assert all((r.follows == -1).all() for r in outcome.records[1:])
    assert outcome.discovery is not None
    (row,) = [r for r in summarise(outcome.records, (outcome.discovery,), resamples=9, seed=0) if r.reading == "all"]
    assert row.metrics.recall is not None
    assert row.metrics.precision is not None
    assert row.metrics.recall.mean == pytest.approx(1 / 3)
    assert row.metrics.place_recall is not None
    assert row.metrics.place_recall.mean == pytest.approx(2 / 3)
    assert row.metrics.precision.mean == pytest.approx(1 / 3)  # a second slot on entity 0 is no second discovery


def test_semantic_never_re_assigns(take: Take) -> None:
    def swapped_later(uv: np.ndarray, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        xyz[8:] = xyz[8:, [1, 0]]
        return uv, xyz

    same_label = dataclasses.replace(
        take,
        info=dataclasses.replace(
            take.info,
            entities=tuple(
                dataclasses.replace(e, label="handle" if i < 3 else "hinge") for i, e in enumerate(take.info.entities)
            ),
        ),
    )
    outcome = evaluate_semantic(Oracle(same_label, slots=(0, 1), change=swapped_later), same_label, 0, SUBJECT)
    for record in outcome.records[:2]:
        assert (record.follows[:8] == record.entity).all()
        assert (record.follows[8:] == 1 - record.entity).all()


def test_semantic_gate(take: Take) -> None:
    def off(uv: np.ndarray, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return uv, xyz + np.array([0, 0, 0.11 * take.info.half_diagonal_m])

    outcome = evaluate_semantic(Oracle(take, slots=(0, 1, 2), change=off), take, 0, SUBJECT)
    assert not any(r.found for r in outcome.records)


def test_assign_prefers_more_pairs_then_less_distance() -> None:
    gap = np.array([[0.01, 0.02], [0.03, 0.2]])
    assert assign(gap, np.ones((2, 2), dtype=bool)) == [(0, 1), (1, 0)]
    gap = np.array([[0.01, 0.02, np.nan], [0.02, 0.01, 0.5]])
    assert assign(gap, np.ones((2, 3), dtype=bool)) == [(0, 0), (1, 1)]
    assert assign(np.zeros((0, 2)), np.zeros((0, 2), dtype=bool)) == []


def test_starts_at_rest(take: Take) -> None:
    assert starts_at_rest(take)
    assert not starts_at_rest(make_take(frames=6))


def _with_visible(take: Take, visible: np.ndarray) -> Take:
    view = dataclasses.replace(take.views[0], visible=visible)
    return dataclasses.replace(take, views=(view,))
