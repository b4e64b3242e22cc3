"""The protocols with trackers whose score is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from quest.errors import ConfigError
from quest.evaluation.protocols import assign, evaluate_point, evaluate_semantic, starts_at_rest, unscored_entities
from quest.evaluation.records import Discovery, EntityRecord, Subject
from quest.evaluation.summary import Metrics, summarise
from quest.types import Take
from tests.evaluation.answers import mean
from tests.evaluation.fakes import Oracle
from tests.synthetic import make_take

Change = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
SUBJECT = Subject("oracle", "point", "validation", "procedural", 3, "panels-0")


@pytest.fixture(scope="module")
def take() -> Take:
    return make_take(frames=40, views=2, entities=3, hinges=True)


def _metrics(take: Take, change: Change = lambda uv, xyz: (uv, xyz)) -> Metrics:
    """Of a tracker that knows the truth but for a change."""
    return _row(evaluate_point(Oracle(take, change=change), take, 0, SUBJECT))


def _row(records: tuple[EntityRecord, ...], discoveries: tuple[Discovery, ...] = ()) -> Metrics:
    (row,) = [r for r in summarise(records, discoveries, resamples=20, seed=0) if r.reading == "all"]
    return row.metrics


def test_the_truth_scores_perfectly(take: Take) -> None:
    metrics = _metrics(take)
    for name in ("ape", "ape_vis", "ape_px", "ape_2d", "median_px", "d50", "d100", "switches", "slope"):
        assert mean(getattr(metrics, name)) == 0.0, name
    assert mean(metrics.acc) == 1.0


def test_a_constant_offset_gives_known_numbers(take: Take) -> None:
    off = np.array([0.0, 0.0, 0.05 * take.info.half_diagonal_m])
    metrics = _metrics(take, lambda uv, xyz: (uv + np.array([3.0, 4.0]), xyz + off))
    expected = {"ape": 0.05, "d100": 0.05, "ape_px": 5.0 * 224 / 64, "ape_2d": 5.0 / 64, "median_px": 17.5, "acc": 1.0}
    assert {name: mean(getattr(metrics, name)) for name in expected} == pytest.approx(expected, rel=1e-4)
    assert mean(metrics.slope) == pytest.approx(0.0, abs=1e-4)


def test_missing_answers_are_not_dropped(take: Take) -> None:
    late = np.arange(len(take))[:, None, None] >= 20
    metrics = _metrics(take, lambda uv, xyz: (np.where(late, np.nan, uv), np.where(late, np.nan, xyz)))
    expected = {"ape": 0.5, "acc": 0.5, "ape_px": 0.5 * 224 * np.sqrt(2), "d100": 1.0}
    assert {name: mean(getattr(metrics, name)) for name in expected} == pytest.approx(expected)


def test_an_answer_on_the_neighbour_is_a_wrong_identity(take: Take) -> None:
    metrics = _metrics(take, lambda uv, xyz: (np.roll(uv, 1, axis=1), np.roll(xyz, 1, axis=1)))
    assert (mean(metrics.acc), mean(metrics.switches)) == (0.0, pytest.approx(1000 / 40))  # once, at the start


def test_point_asks_by_pixel_only_and_from_the_first_visible_frame(take: Take) -> None:
    visible = take.views[0].visible.copy()
    visible[:3, 1] = False  # shows itself in frame 3
    visible[:8, 2] = False  # too late
    hidden = _with_visible(take, visible)
    oracle = Oracle(hidden)
    records = evaluate_point(oracle, hidden, 0, SUBJECT)
    assert [(q.frame, q.label) for q in oracle.asked] == [(0, None), (3, None)]
    assert all(label not in q.name for q in oracle.asked for label in ("handle", "knob", "rim", "front"))
    assert [(r.entity, r.first_frame) for r in records] == [(0, 0), (1, 3)]
    assert mean(_row(records).ape) == 0.0  # nothing was asked before frame 3
    assert [(u.view, u.name) for u in unscored_entities(hidden)] == [(0, "link_2/rim")]


def test_no_visible_entity_gives_no_records(take: Take) -> None:
    blind = _with_visible(take, np.zeros_like(take.views[0].visible))
    oracle = Oracle(blind, slots=(0, 1))
    assert evaluate_point(oracle, blind, 0, SUBJECT) == ()
    records, discovery = evaluate_semantic(oracle, blind, 0, SUBJECT)
    assert records == ()
    assert (discovery.slots, discovery.matched) == (2, 0)
    assert summarise((), (discovery,), resamples=5, seed=0) == ()


def test_hinges_are_neither_scored_nor_confusable(take: Take) -> None:
    assert {r.entity for r in evaluate_point(Oracle(take), take, 0, SUBJECT)} == {0, 1, 2}

    hinges = take.point_world[:, 3:6].copy()
    records = evaluate_point(Oracle(take, change=lambda uv, xyz: (uv, hinges)), take, 0, SUBJECT)
    assert all((r.follows < 3).all() for r in records)


def test_a_tracker_must_answer_every_query(take: Take) -> None:
    class Lazy(Oracle):
        def track(self, clip, queries=None):
            return super().track(clip, queries).select([0])

    with pytest.raises(ConfigError, match="expected answers"):
        evaluate_point(Lazy(take), take, 0, SUBJECT)


def test_semantic_truth_scores_perfectly(take: Take) -> None:
    records, discovery = evaluate_semantic(Oracle(take, slots=(2, 0, 1)), take, 0, SUBJECT)
    assert [r.found for r in records] == [True] * 3
    assert mean(_row(records).ape) == 0.0
    assert (discovery.slots, discovery.matched) == (3, 3)


def test_semantic_undiscovered_and_unsure_and_mislabelled_are_missing(take: Take) -> None:
    semantic = replace(SUBJECT, protocol="semantic")
    oracle = Oracle(
        take, slots=(0, 1, 2, 0), labels=("handle", "rim", "rim", "handle"), confidence=(0.9, 0.9, 0.4, 0.6)
    )
    records, discovery = evaluate_semantic(oracle, take, 0, semantic)
    assert [r.found for r in records] == [True, False, False]  # 1 has the wrong label, 2 is unsure
    assert [float(r.distance.mean()) for r in records] == [0.0, 1.0, 1.0]
    assert all((r.follows == -1).all() for r in records[1:])
    metrics = _row(records, (discovery,))
    found = [mean(each) for each in (metrics.recall, metrics.place_recall, metrics.precision)]
    assert found == pytest.approx([1 / 3, 2 / 3, 1 / 3])  # a second slot on entity 0 is no second discovery


def test_semantic_never_re_assigns(take: Take) -> None:
    def swapped_later(uv: np.ndarray, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        xyz[8:] = xyz[8:, [1, 0]]
        return uv, xyz

    entities = (replace(e, label="handle" if i < 3 else "hinge") for i, e in enumerate(take.info.entities))
    same_label = replace(take, info=replace(take.info, entities=tuple(entities)))
    records, _ = evaluate_semantic(Oracle(same_label, slots=(0, 1), change=swapped_later), same_label, 0, SUBJECT)
    for record in records[:2]:
        assert (record.follows[:8] == record.entity).all()
        assert (record.follows[8:] == 1 - record.entity).all()


def test_semantic_gate(take: Take) -> None:
    off = np.array([0, 0, 0.11 * take.info.half_diagonal_m])
    records, _ = evaluate_semantic(
        Oracle(take, slots=(0, 1, 2), change=lambda uv, xyz: (uv, xyz + off)), take, 0, SUBJECT
    )
    assert not any(r.found for r in records)


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
    view = replace(take.views[0], visible=visible)
    return replace(take, views=(view,))
