"""Which of what was found a text means."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from quest.model.finder import OPENINGS, PANELS
from quest.model.found import APART_PX, LABELS_FOUND, Found, Panels
from quest.text.meaning import Meaning, Which, understand
from quest.types import LABELS
from quest.wording import counted

_AWAY_FROM = {"left": (1, 0), "right": (-1, 0), "top": (0, 1), "bottom": (0, -1)}
_AT_ONE_PLACE = 0.5
"""Of the smaller one's extent: what is less apart is at the same place, as seen from a side."""
_ALIKE = 0.4
"""Of its area, stands for an extent where sizes are compared."""


@dataclass(frozen=True)
class Chosen:
    """What a text means among what was found."""

    rows: Int[np.ndarray, " K"]
    """Rows of what was found; none where the text names what is not there."""
    meaning: Meaning
    """How the text was understood."""
    missing: str = ""
    """What is not there, in words."""


class _MissingError(Exception):
    """What is not there, in words."""


def choose(found: Found, text: str | Meaning, *, least: float, least_of_any: float | None = None) -> Chosen:
    """What a text means among what was found.

    "Left handle" is the leftmost, "left handles" are those in the left half of all, "left drawers" the leftmost column.
    Where any one will do it is the likeliest. Where two are as far left, or fewer are there than the text names,
    nothing is chosen.

    Args:
        found: by the finder.
        text: such as "the lever of the left door".
        least: least probability of what is told apart by place or number.
        least_of_any: that where any one will do, which may be lower because somebody says that it is there.

    Raises:
        InputError: the text is not understood.
        MissingExtraError: a word needs the extra ``text``.
    """
    meaning = understand(text) if isinstance(text, str) else text
    thing, panel = meaning.thing, meaning.panel
    least = least if least_of_any is None or not thing.plain else least_of_any
    places, rows, missing = _places(found, meaning), [], ""
    there = (places.sure >= least) & (places.sure > 0)
    try:
        if panel is None:
            rows = _pick(thing, places, there, halves=True)
        else:
            panels = _pick_panels(panel, found.panels)
            for group in [[k] for k in panels] if meaning.by_panel else [panels]:
                try:
                    rows += _pick(thing, places, there & np.isin(found.panel, group), halves=True)
                except _MissingError as error:
                    missing = f"{error} on {panel.named}"
                    if panel.count not in ("all", "each"):
                        rows = []
                        break
    except _MissingError as error:
        missing = str(error)
    return Chosen(np.array(rows, np.int64), meaning, missing)


@dataclass(frozen=True)
class _Places:
    """Things or panels in the picture."""

    at_px: Float[np.ndarray, "N 2"]
    extent_px: Float[np.ndarray, "N 2"]
    sure: Float[np.ndarray, " N"]

    def along(self, side: str) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
        """How far they are from a side, or how far from the largest in size, and their extent in that."""
        if side in _AWAY_FROM:
            direction = np.array(_AWAY_FROM[side])
            return self.at_px @ direction, self.extent_px @ abs(direction)
        area = self.extent_px.prod(axis=1)
        return (-area if side == "largest" else area), _ALIKE * area

    def levels(self, rows: Sequence[int], side: str) -> list[list[int]]:
        """Those at the same place together, beginning at a side."""
        along, extent = self.along(side)
        levels: list[list[int]] = []
        for row in sorted(rows, key=lambda row: along[row]):
            first = levels[-1][0] if levels else row
            if levels and along[row] - along[first] < _AT_ONE_PLACE * min(extent[row], extent[first]):
                levels[-1].append(row)
            else:
                levels.append([row])
        return levels

    def half(self, rows: Sequence[int], side: str) -> list[int]:
        """Those on the side of the middle; all where they are at the same place."""
        if len(self.levels(rows, side)) == 1:
            return list(rows)
        along = self.along(side)[0]
        middle = (along[rows].min() + along[rows].max()) / 2
        return [row for row in rows if along[row] < middle]


def _places(found: Found, meaning: Meaning) -> _Places:
    """Where things are, and how likely they are what is meant."""
    labels = [LABELS_FOUND.index(label) for label in meaning.thing.nouns or LABELS]
    of_label = found.label_p[:, labels].sum(axis=1)
    of_intent = {"lift": found.lift_p, "open": 1 - found.lift_p}.get(meaning.intent or "", np.ones(len(found)))
    if not meaning.thing.plain:  # as they are listed, so that none is counted as two
        of_label, of_intent = of_label >= 0.5, of_intent >= 0.5
    extent = found.box_px[:, 2:] - found.box_px[:, :2]
    return _Places(found.uv_px, np.where(np.isnan(extent), APART_PX, extent), found.p * of_label * of_intent)


def _pick_panels(which: Which, panels: Panels) -> list[int]:
    """The doors or drawers that are meant; all of a kind where any one will do.

    Raises:
        _MissingError: they are not there.
    """
    box, kind = panels.box_px, np.array([PANELS[int(k)] for k in panels.kind], object)
    slides = panels.opening_p.argmax(axis=1) == OPENINGS.index("slides")
    of_room = kind == "door"
    is_one: dict[str, Bool[np.ndarray, " M"]] = {
        "room door": of_room, "door": of_room | ~slides, "drawer": ~of_room & slides,
        "cabinet": kind == "cabinet", "refrigerator": kind == "refrigerator",
    }  # fmt: skip
    there = np.logical_and.reduce([panels.logit > 0, *(is_one[noun] for noun in which.nouns)])
    if which.plain and there.any():
        return np.flatnonzero(there).tolist()
    places = _Places((box[:, :2] + box[:, 2:]) / 2, box[:, 2:] - box[:, :2], panels.logit)
    return _pick(which, places, there, halves=False)


def _pick(which: Which, places: _Places, there: Bool[np.ndarray, " N"], *, halves: bool) -> list[int]:
    """Those that are meant, of those that are there.

    Raises:
        _MissingError: they are not there, or several are as likely meant.
    """
    rows = sorted(np.flatnonzero(there).tolist(), key=lambda row: -places.sure[row])
    several = which.count != "1"

    def so_many(number: int) -> str:
        return counted(number, which.noun(several=False), which.noun(several=True))

    if not rows:
        raise _MissingError(f"no {which.noun(several=False)} was found")
    if several and which.count.isdigit():
        if which.sides or which.nth:
            levels = places.levels(rows, which.sides[0] if which.sides else which.origin or "")
            rows = [row for level in levels[:: which.nth or 1] for row in level]
        if len(rows) < int(which.count):
            raise _MissingError(f"{so_many(len(rows))} found, not {which.count}")
        return rows[: int(which.count)]
    for side in which.sides:
        among = several or which.nth is not None
        rows = places.half(rows, side) if among and halves else places.levels(rows, side)[0]
    if which.nth is not None:
        levels = places.levels(rows, which.origin or "")
        if which.nth > len(levels) or (which.nth == 0 and len(levels) % 2 == 0):
            raise _MissingError(f"found {so_many(len(levels))} from the {which.origin}, no {which}")
        rows = levels[which.nth - (which.nth > 0) if which.nth else len(levels) // 2]
    elif which.plain:
        rows = rows[:1]
    if len(rows) > 1 and not several:
        raise _MissingError(f"{so_many(len(rows))} could be {which.named}; say more")
    if which.count == "both" and len(rows) != 2:
        raise _MissingError(f"{so_many(len(rows))} found, not both")
    return rows
