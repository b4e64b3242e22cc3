from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
from rich.console import Console

from quest.monitor import Budget
from quest.types import Query
from quest.viz.live import LiveView, query_words
from tests.track.test_events import ALARM, make_state
from tests.track.test_state_lines import DOOR, HINGE


def make_view(
    *,
    terminal: bool,
    width: int = 120,
    budget: Budget | None = Budget(0.05, 90),  # noqa: B008
) -> tuple[LiveView, io.StringIO]:
    file = io.StringIO()
    console = Console(
        file=file, width=width, force_terminal=terminal, force_interactive=terminal, color_system=None,
        legacy_windows=False,
    )  # fmt: skip
    return LiveView(console, name="clip [red]", frames=9, budget=budget), file


def text_of(view: LiveView, width: int) -> str:
    file = io.StringIO()
    Console(file=file, width=width).print(view.picture())
    return file.getvalue()


def test_query_words():
    assert query_words(Query.semantic("handle")) == "handle"
    assert query_words(Query.slot(name="any")) == "any"
    assert query_words(Query.point(20, 3, 4)) == "point (from frame 20 on)"


def test_a_terminal_gets_one_table_that_stays():
    view, file = make_view(terminal=True)
    with view:
        view.show(0, make_state())
        state = replace(
            DOOR, joint=(HINGE, None), q=np.array([np.pi / 2, np.nan], np.float32), alarm=(ALARM, None),
            flags=("no depth",), lost_p=np.array([0.8, np.nan], np.float32),
        )  # fmt: skip
        view.show(5, state, waiting=[Query.semantic("knob")], behind_s=1.25)
    assert "frame 5 (0 to 8)" in file.getvalue()
    text = text_of(view, 120)
    for part in (
        *("clip [red]", "frame 5 (0 to 8)", "alpha 0.05 in 90 frames", "1.2 s behind", "degraded: no depth"),
        *("left", "handle", "tracking", "1.0 1.0", "0.00 0.50 0.00", "revolute 90 deg (0 to 57)", "0.80", "3 frames"),
        *("alarm: left, open for 3 frames: looks unlike its anchor", "now following left, right"),
        "not followed: knob",
    ):
        assert part in text
    assert max(len(line) for line in text_of(view, 80).splitlines()) <= 80
    narrow, _ = make_view(terminal=True, width=80)
    narrow.show(0, make_state())
    assert "handle" not in text_of(narrow, 80)


def test_without_alarms():
    view, _ = make_view(terminal=True, budget=None)
    view.show(0, make_state(lost_p=np.full(2, np.nan, np.float32)))
    assert "without calibration" in text_of(view, 120)
    assert "no alarms" in view.summary().plain


def test_elsewhere_one_line_per_event():
    view, file = make_view(terminal=False)
    with view:
        view.show(0, make_state())
        view.show(1, make_state())
        view.show(2, make_state(alarm=(ALARM, None), stamp_s=0.2))
    first, second = file.getvalue().splitlines()
    assert first.endswith("now following left, right")
    assert second == "frame    2    0.20 s  left  ALARM: looks unlike its anchor"
    assert view.summary().plain.endswith("alarms: 1 raised, 0 cleared, 1 left open")
