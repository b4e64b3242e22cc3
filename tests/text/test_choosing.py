"""What texts choose among what was found, in pictures made up of doors and drawers."""

from __future__ import annotations

import numpy as np
import pytest

from quest.errors import InputError
from quest.model.finder import OPENINGS, PANELS
from quest.model.found import LABELS_FOUND, Found, Panels
from quest.text import choose, understand

Box = tuple[float, float, float, float]


def thing(at: tuple[float, float], label: str = "handle", *, panel: int = -1, p: float = 0.9, lift: float = 0.0):
    return at, label, panel, p, lift


def made_up(things: list, panels: list[tuple[str, str, Box]] = []) -> Found:  # noqa: B006
    """Things, and panels by kind, opening and box; handles and knobs have boxes of 20 x 8 pixels."""
    at = np.array([t[0] for t in things], np.float64).reshape(-1, 2)
    grips = np.array([t[1] in ("handle", "knob") for t in things], bool)
    p = np.array([t[3] for t in things], np.float64)
    boxes = np.array([box for *_, box in panels], np.float64).reshape(-1, 4)
    kinds = np.array([PANELS.index(kind) for kind, *_ in panels], np.int64)
    openings = np.eye(len(OPENINGS))[[OPENINGS.index(opening) for _, opening, _ in panels]]
    return Found(
        uv_px=at,
        logit=np.log(p / (1 - p)),
        label_p=np.eye(len(LABELS_FOUND))[[LABELS_FOUND.index(t[1]) for t in things]],
        lift_p=np.array([t[4] for t in things], np.float64),
        box_px=np.where(grips[:, None], np.tile(at, 2) + np.array([-10, -4, 10, 4]), np.nan),
        panel=np.array([t[2] for t in things], np.int64),
        panels=Panels(boxes, kinds, np.full(len(panels), 2.0), openings.reshape(-1, len(OPENINGS))),
    )


KITCHEN = made_up(
    [
        thing((90, 50), "knob", panel=0),  # 0
        thing((110, 52), panel=1, p=0.6),  # 1
        thing((250, 20), panel=2, p=0.8),  # 2
        thing((230, 60), panel=3),  # 3
        thing((270, 61), panel=3, p=0.7),  # 4
        thing((250, 101), "front", panel=4, p=0.4),  # 5
        thing((330, 40), panel=5, p=0.3),  # 6
        thing((390, 100), "rim", lift=0.9),  # 7
        thing((5, 50), "hinge", panel=0),  # 8
        thing((310, 95), "knob", panel=5, p=0.05),  # 9
    ],
    [
        ("cabinet", "left", (0, 0, 98, 120)),
        ("cabinet", "right", (100, 2, 198, 120)),
        ("cabinet", "slides", (200, 0, 300, 38)),
        ("cabinet", "slides", (200, 40, 300, 80)),
        ("cabinet", "slides", (201, 82, 300, 120)),
        ("refrigerator", "right", (302, 0, 380, 120)),
    ],
)
"""Two doors, three drawers, of which the middle one has two handles, a refrigerator, and something to lift."""


def chosen(text: str, found: Found = KITCHEN) -> list[int]:
    return choose(found, text, least=0.5, least_of_any=0.2).rows.tolist()


MEANT = [
    ("handle", [3]), ("all handles", [3, 2, 4, 1]), ("two handles", [3, 2]), ("hinges", [8]),
    ("handles or knobs", [0, 3, 2, 4, 1]), ("left handle", [1]), ("rightmost handle", [4]), ("top handle", [2]),
    ("handles on the left", [1]), ("two left handles", [1, 3]), ("second handle from the left", [3]),
    ("last handle from the left", [4]), ("the first two handles from the right", [4, 2]), ("fridge handle", [6]),
    ("left door", [0]), ("knob of the left door", [0]), ("handle of the second door from the left", [1]),
    ("cabinet door handle", [1]), ("drawer handles", [3, 2, 4]), ("second drawer handles", [3, 4]),
    ("left handle of the second drawer", [3]), ("right handle of the middle drawer", [4]), ("top drawer", [2]),
    ("lowest drawer", [5]), ("drawer 1", [2]), ("both cabinet doors", [0, 1]), ("every drawer", [3, 5, 2]),
    ("first two drawers", [2, 3]), ("last drawer from the top", [5]), ("pick it up by the rim", [7]),
    ("something to lift", [7]), ("drawer 3 front", [5]), ("second cabinet drawer on the left", [3]),
    ("everything on the freezer", []),
]  # fmt: skip


@pytest.mark.parametrize(("text", "rows"), MEANT)
def test_what_is_meant(text: str, rows: list[int]):
    assert sorted(chosen(text)) == sorted(rows)
    if "from" in text or rows == []:
        assert chosen(text) == rows


@pytest.mark.parametrize(
    ("text", "missing"),
    [
        ("fourth drawer", "found 3 drawers from the top, no fourth drawer from the top"),
        ("three knobs", "1 knob found, not 3"),
        ("both handles", "4 handles found, not both"),
        ("both doors", "3 doors found, not both"),
        ("handle of the left door", "no handle was found on the leftmost door"),
        ("knob of every drawer", "no knob was found on each drawer"),
        ("room door", "no room door was found"),
        ("middle door", ""),
        ("middle handle of the second drawer", "found 2 handles from the left, no middle handle from the left on"),
        ("top door", "3 doors could be the topmost door; say more"),
        ("largest cabinet door", "2 cabinet doors could be the largest cabinet door"),
        ("rim to open", "no rim was found"),
        ("two places on the left door", "1 place to hold found, not 2 on the leftmost door"),
    ],
)
def test_what_is_not_there_is_not_guessed(text: str, missing: str):
    answer = choose(KITCHEN, text, least=0.5, least_of_any=0.2)
    assert (len(answer.rows) == 0) == bool(missing)
    assert missing in answer.missing


def test_columns_and_rows_of_drawers():
    """Drawers whose edges do not quite line up, 2 columns of 3."""
    shift = iter((0, 3, -2, 1, 4, 2))
    boxes = [(x + (d := next(shift)), y - d, x + 90 + d, y + 38 - d) for y in (0, 40, 80) for x in (0, 100)]
    found = made_up(
        [thing(((b[0] + b[2]) / 2, b[1] + 19), panel=k) for k, b in enumerate(boxes)],
        [("cabinet", "slides", box) for box in boxes],
    )
    assert chosen("top left drawer", found) == [0]
    assert chosen("bottom right drawer", found) == [5]
    assert chosen("second drawer on the right", found) == [3]
    assert sorted(chosen("top drawers", found)) == [0, 1]
    assert sorted(chosen("drawers on the left", found)) == [0, 2, 4]
    assert sorted(chosen("upper handles", found)) == [0, 1]
    assert chosen("second drawer", found) == []
    assert len(chosen("all drawers", found)) == 6


def test_sizes():
    boxes: list[Box] = [(0, 0, 100, 30), (0, 32, 100, 90), (0, 92, 100, 200)]
    found = made_up(
        [thing((50, (box[1] + box[3]) / 2), panel=k) for k, box in enumerate(boxes)],
        [("cabinet", "slides", box) for box in boxes],
    )
    for text, row in (("largest drawer", 2), ("second largest drawer", 1), ("the small drawer", 0)):
        assert chosen(text, found) == [row]


def test_part_of_all_is_said():
    found = made_up([thing((50, 20), panel=0)], [("cabinet", "slides", (0, y, 100, y + 40)) for y in (0.0, 45.0)])
    answer = choose(found, "all drawers", least=0.5)
    assert answer.rows.tolist() == [0]
    assert "no place to hold was found" in answer.missing
    assert choose(found, "both drawers", least=0.5).rows.tolist() == []


def test_probabilities():
    unsure = made_up([thing((10, 50), p=0.3), thing((90, 50), p=0.4)])
    assert chosen("handle", unsure) == [1]
    assert chosen("left handle", unsure) == []
    assert choose(unsure, "left handle", least=0.2).rows.tolist() == [0]
    assert choose(unsure, "handle", least=0.5).rows.tolist() == []
    assert choose(unsure, "all knobs", least=0.0).rows.tolist() == []


def test_nothing_found():
    for text in ("handle", "all handles", "left door", "both drawers", "handles of each drawer"):
        answer = choose(made_up([]), understand(text), least=0.5)
        assert answer.meaning == understand(text)
        assert len(answer.rows) == 0
        assert "was found" in answer.missing
    with pytest.raises(InputError):
        choose(KITCHEN, "handle beside the door", least=0.5)
