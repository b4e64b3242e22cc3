from __future__ import annotations

from dataclasses import replace

import numpy as np

from quest.monitor import Alarm
from quest.track import StreamState
from quest.track.events import Events
from quest.types import State

ALARM = Alarm("left", 4, 2, 0.2, 9.0, 5.0, 0.05, "looks unlike its anchor")


def make_state(**changes: object) -> StreamState:
    """Two queries that are tracked."""
    state = StreamState(
        names=("left", "right"),
        labels=("handle", None),
        uv_px=np.ones((2, 2), np.float32),
        point_world=np.ones((2, 3), np.float32),
        confidence=np.full(2, 0.9, np.float32),
        visible=np.ones(2, bool),
        state=(State.TRACKING, State.TRACKING),
        stamp_s=0.0,
        has_depth=True,
        query=(4, 7),
        joint=(None, None),
        q=np.full(2, np.nan, np.float32),
        lost_p=np.zeros(2, np.float32),
        alarm=(None, None),
        lost_log_odds=np.full(2, -3.0, np.float32),
    )
    return replace(state, **changes)


def kinds(events: Events, *states: StreamState) -> list[list[str]]:
    return [[event.kind for event in events.step(t, state)] for t, state in enumerate(states)]


def test_nothing_happens():
    events = Events()
    assert kinds(events, make_state(), make_state(), make_state()) == [["bound"], [], []]


def test_an_alarm_and_its_end():
    """The loss that comes with an alarm, and the end of both, are told once."""
    events = Events()
    lost = make_state(alarm=(ALARM, None), state=(State.LOST, State.TRACKING))
    later = events, make_state(), make_state(), lost, lost, make_state(), make_state()
    assert kinds(*later) == [["bound"], [], ["alarm"], [], ["cleared"], []]
    assert (events.raised, events.cleared) == (1, 1)


def test_words():
    events = Events()
    events.step(0, make_state())
    (event,) = events.step(2, make_state(alarm=(ALARM, None), stamp_s=0.2))
    assert (event.frame, event.stamp_s, event.name) == (2, 0.2, "left")
    assert ALARM.reason in event.text
    (event,) = events.step(9, make_state())
    assert "after 7 frames" in event.text


def test_an_alarm_after_the_other():
    events = Events()
    again = make_state(alarm=(replace(ALARM, frame=3), None))
    assert kinds(events, make_state(alarm=(ALARM, None)), again) == [["bound", "alarm"], ["cleared", "alarm"]]
    assert (events.raised, events.cleared) == (2, 1)


def test_lost_and_found_without_an_alarm():
    lost = make_state(state=(State.TRACKING, State.LOST))
    assert kinds(Events(), make_state(), lost, lost, make_state()) == [["bound"], ["lost"], [], ["found"]]


def test_queries_come_and_go():
    one = make_state(
        **{n: getattr(make_state(), n)[1:] for n in ("names", "labels", "uv_px", "point_world", "confidence")},
        **{n: getattr(make_state(), n)[1:] for n in ("visible", "state", "query", "joint", "q", "lost_p", "alarm")},
        lost_log_odds=np.zeros(1, np.float32),
    )
    events = Events()
    assert kinds(events, one, make_state(), one) == [["bound"], ["bound"], []]
    (event,) = Events().step(0, make_state())
    assert event.text.endswith("left, right")


def test_a_clock_that_went_back_is_told_once():
    late = [make_state(flags=(f"late: {t / 30:.3f} s older than the frame before; ignored",)) for t in range(3, 0, -1)]
    assert kinds(Events(), *late) == [["bound", "degraded"], [], []]


def test_a_degradation_is_told_once():
    dark = make_state(flags=("no depth",))
    assert kinds(Events(), dark, dark, make_state(), dark) == [["bound", "degraded"], [], [], ["degraded"]]
