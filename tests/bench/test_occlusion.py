"""Entities that are hidden and seen again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from quest.bench.occlusion import STILL, episodes, reappearances
from quest.errors import InputError
from quest.evaluation import EntityRecord
from tests.evaluation.answers import make_answer

FRAMES, START, END = 60, 20, 45


def hidden(start: int = START, end: int = END, frames: int = FRAMES) -> np.ndarray:
    visible = np.ones(frames, bool)
    visible[start:end] = False
    return visible


def answers(
    distance: np.ndarray,
    *,
    object_id: str = "desk-1",
    alike: bool = False,
    visible: np.ndarray | None = None,
    follows: np.ndarray | None = None,
    moves_at: int = 10,
    **about,
) -> list[EntityRecord]:
    """The judged tracker's answer, and that of a tracker that holds still while the entity moves on."""
    take = f"{object_id}-L1-occlusion60{'alike' if alike else ''}-s000000"
    visible = hidden() if visible is None else visible
    still = 0.3 + 0.01 * np.maximum(np.arange(len(distance)) - moves_at, 0)
    about |= {"object_id": object_id, "take": take, "visible": visible}
    return [make_answer(distance, follows=follows, **about), make_answer(still, tracker=STILL, **about)]


def of_quest(records: list[EntityRecord]) -> list[tuple[int, int]]:
    return [(e.start, e.end) for e in episodes(records) if e.record.subject.tracker == "quest"]


def test_when_an_episode_begins_and_ends():
    flat = np.zeros(FRAMES)
    assert of_quest(answers(flat)) == [(START, END)]
    assert of_quest(answers(flat, visible=hidden(20, 39))) == []  # 19 frames
    assert of_quest(answers(flat, visible=hidden(20, 60))) == [(20, 60)]
    assert of_quest(answers(flat, moves_at=19)) == []  # starts to move as it is hidden
    assert of_quest(answers(flat, moved=False)) == []
    twice = hidden(2, 23) & hidden(30, 55)
    assert of_quest(answers(flat, visible=twice, moves_at=0)) == [(30, 55)]
    assert of_quest(answers(flat, visible=twice, moves_at=25)) == [(30, 55)]


def test_other_suites_and_protocols_are_left_out():
    on, still = answers(np.zeros(FRAMES))
    for changes in ({"take": "desk-1-L1-s000000"}, {"subject": replace(on.subject, protocol="semantic")}):
        assert episodes([replace(on, **changes)]) == []
    with pytest.raises(InputError, match="hold-still"):
        episodes([on])
    assert len(episodes([on, still])) == 2


def test_shares_and_distances():
    records: list[EntityRecord] = []
    for i in range(6):
        distance = np.full(FRAMES, 0.01 * (i + 1))
        distance[START:END] = 0.5
        distance[END + 5], distance[-1] = 0.1 * i, 0.2 * i
        follows = np.ones(FRAMES, int)
        follows[START - 1] = -1 if i == 0 else 1  # one is not held before
        follows[END : END + 5] = 2
        follows[END + 5] = 2 if i < 2 else 1  # two are not held again
        records += answers(distance, object_id=f"desk-{i}", alike=i < 4, follows=follows)
    rows = {r["beside"]: r for r in reappearances(records, resamples=100, seed=0) if r["tracker"] == "quest"}
    row = rows["both"]
    counts = ("objects", "takes", "episodes", "judged", "hidden_frames")
    assert [row[name] for name in counts] == [6, 6, 6, 6, END - START]
    held = [row[name] for name in ("held_before", "held_again", "held_again_if_before")]
    assert [(share.hits, share.trials) for share in held] == [(5, 6), (4, 6), (4, 5)]
    assert held[1].low == pytest.approx(0.2228, abs=1e-4)  # Clopper and Pearson, 4 of 6
    assert held[1].high == pytest.approx(0.9567, abs=1e-4)
    assert held[1].over_objects.low is not None
    assert row["ape_hidden"].mean == pytest.approx(0.5)
    assert row["ape_hidden"].count == 6 * (END - START)
    assert row["distance_again"].mean == pytest.approx(0.25)
    assert row["distance_end"].mean == pytest.approx(0.5)
    assert (rows["alike"]["episodes"], rows["alone"]["episodes"]) == (4, 2)
    assert rows["alone"]["held_again"].share == 1.0


def test_what_is_not_seen_again_long_enough_is_not_judged():
    (row, _) = reappearances(answers(np.full(FRAMES, 0.1), visible=hidden(20, 55)), resamples=10, seed=0)[2:]
    assert (row["tracker"], row["beside"], row["episodes"], row["judged"]) == ("quest", "both", 1, 0)
    assert row["held_before"] is not None
    assert row["ape_hidden"] is not None
    assert {row[n] for n in ("held_again", "held_again_if_before", "distance_again", "distance_end")} == {None}
    seen = answers(np.zeros(FRAMES), visible=hidden(20, 54))
    assert reappearances(seen, resamples=10, seed=0)[-1]["judged"] == 1
