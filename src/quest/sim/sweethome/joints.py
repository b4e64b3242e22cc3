"""How a model opens: by the names of its groups, or by what was noted by hand for models that have none.

Here models stand as objects do: metres, z up, the front towards +x, so that left is -y as seen from the front.
In Sweet Home 3D a group ``sweethome3d_hinge_1`` is a pin whose longest extent is the axis about which groups called
``sweethome3d_opening_on_hinge_1_...`` turn; on ``sweethome3d_rail_1`` they slide along it, as far as it reaches.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from quest.errors import ObjectError
from quest.sim.sweethome.wavefront import Wavefront
from quest.untrusted import build, read_json

NOTES = Path(__file__).parents[2] / "assets" / "objects" / "sweethome3d.json"

_TAG = re.compile(r"sweethome3d_(opening_on_|window_pane_on_|window_mirror_on_|unique_|)(hinge|rail)(?:_(\d+))?")
_WORDS = {
    "handle": re.compile(r"handle(?!r)|maneta|poignee|latch|tirador|lever", re.IGNORECASE),
    "knob": re.compile(r"knob|pomo\b", re.IGNORECASE),
    "glass": re.compile(r"glass|pane(?![ls])|vidr|pyrex", re.IGNORECASE),
}
_QUARTER_DEG = 90.0
_OPENS_BY = 0.75
"""How far a drawer opens, as a share of the model's depth, where nothing else is noted."""
_TOLERANCE = 0.008


@dataclass(frozen=True)
class Pick:
    """Connected pieces of a model: those that all three fields agree to."""

    group: str = "*"
    """Pattern of their group's name."""
    material: str = "*"
    """Pattern of their material's name."""
    box: tuple[float, float, float, float, float, float] = (0, 0, 0, 1, 1, 1)
    """Where they lie entirely, lower and upper corner: 0 is the model's back, left and bottom, 1 its other end."""

    def faces(self, shape: Wavefront) -> Bool[np.ndarray, " F"]:
        """The faces of these pieces."""
        group = np.array([fnmatchcase(name, self.group) for name in shape.groups])
        material = np.array([fnmatchcase(name, self.material) for name in shape.materials])
        low, extent = shape.vertices.min(axis=0), np.maximum(np.ptp(shape.vertices, axis=0), 1e-9)
        piece, bounds = shape.pieces
        share = (bounds - low) / extent
        inside = (share[:, 0] >= np.array(self.box[:3]) - _TOLERANCE).all(axis=1)
        inside &= (share[:, 1] <= np.array(self.box[3:]) + _TOLERANCE).all(axis=1)
        return group[shape.group] & material[shape.material] & inside[piece]


@dataclass(frozen=True)
class LinkNote:
    """A part that opens."""

    name: str
    opens: Literal["left", "right", "top", "bottom", "lid", "slide", "slide-left", "slide-right"]
    """The edge of its front on which it turns, as seen from the front; ``lid``: its lower edge at the back."""
    pick: tuple[Pick, ...]
    by: float | None = None
    """Degrees, or metres, that it opens by."""
    ajar: float = 0.0
    """Degrees, or metres, that it is open in the model."""
    axis: tuple[float, float, float] | None = None
    """A point on the axis, as shares like those of a box, where it is not at that edge."""
    tray: bool = False
    """A drawer that is modelled as its front alone gets a bottom and sides."""


@dataclass(frozen=True)
class Note:
    """What was noted of a model."""

    category: str = ""
    """In PartNet-Mobility's words."""
    thing: str = ""
    """Why the joints that its groups tell are of no use: it becomes a thing."""
    skip: str = ""
    """Why it is left out."""
    turn: float = 0.0
    """Degrees about the vertical that bring its front to the front."""
    by: float | None = None
    """Degrees that what is told by its groups opens by; below 0 to the other side."""
    ajar: float = 0.0
    """Degrees that this is open in the model."""
    links: tuple[LinkNote, ...] = ()
    handles: tuple[Pick, ...] = ()
    knobs: tuple[Pick, ...] = ()


@dataclass(frozen=True)
class Link:
    """A part that moves, with its joint."""

    name: str
    kind: Literal["revolute", "prismatic"]
    faces: Bool[np.ndarray, " F"]
    origin: Float[np.ndarray, "3"]
    """A point on the axis, metres."""
    axis: Float[np.ndarray, "3"]
    """Opens towards it, or about it."""
    opens_by: float
    """Radians or metres."""
    ajar: float = 0.0
    """Radians or metres by which the model is open."""
    tray: Float[np.ndarray, "2 3"] | None = field(default=None)
    """Lower and upper corner of the drawer to be added behind its front."""


@cache
def notes() -> Mapping[str, Note]:
    """Notes by the path of the model in its library.

    Raises:
        ObjectError: the file is damaged.
    """
    raw = read_json(NOTES, ObjectError, "install QueST again")
    try:
        return build(dict[str, Note], raw, NOTES.name)
    except ValueError as error:
        raise ObjectError(f"{NOTES}: {error}; install QueST again") from error


def grips(shape: Wavefront, note: Note) -> dict[str, Bool[np.ndarray, " F"]]:
    """Faces of handles, knobs and panes, by groups, materials and notes; no face is in two."""
    found, taken = {}, np.zeros(len(shape.group), dtype=bool)
    noted = {"handle": note.handles, "knob": note.knobs}
    for label, named in _WORDS.items():
        faces = _any(shape, noted.get(label, ()))
        if not (note.handles or note.knobs) or label == "glass":
            of_group, of_material = (
                np.array([bool(named.search(_TAG.sub("", name) if label != "glass" else name)) for name in names])
                for names in (shape.groups, shape.materials)
            )
            faces |= of_group[shape.group] | of_material[shape.material]
        found[label] = faces & ~taken
        taken |= faces
    return found


def _any(shape: Wavefront, picks: Sequence[Pick]) -> Bool[np.ndarray, " F"]:
    faces = np.zeros(len(shape.group), dtype=bool)
    for pick in picks:
        faces |= pick.faces(shape)
    return faces


def find_links(shape: Wavefront, note: Note) -> list[Link]:
    """The parts that move; none if the model is a thing.

    Raises:
        ValueError: a note fits the model no more, or a tag has no pin or rail.
    """
    if note.thing:
        return []
    if note.links:
        labelled = grips(shape, note)
        grip = labelled["handle"] | labelled["knob"]
        return [_noted(shape, link, grip) for link in note.links]
    return _tagged(shape, note)


def _noted(shape: Wavefront, note: LinkNote, grip: Bool[np.ndarray, " F"]) -> Link:
    faces = _any(shape, note.pick)
    if not faces.any():
        raise ValueError(f"{note.name}: nothing of it is in the model")
    points, whole = shape.points(faces & ~grip if (faces & ~grip).any() else faces), shape.vertices
    low, high = points.min(axis=0), points.max(axis=0)
    middle, back = (low + high) / 2, float(whole[:, 0].min())
    if note.opens.startswith("slide"):
        room = float(high[0]) - back
        tray = np.array([[back + 0.1 * room, *low[1:]], [low[0], *high[1:]]]) if note.tray else None
        side = {"slide": 0, "slide-left": -1, "slide-right": 1}[note.opens]
        usual = _OPENS_BY * room if side == 0 else 0.9 * float(high[1] - low[1])
        axis = np.array([float(side == 0), side, 0])
        by = usual if note.by is None else note.by
        return Link(note.name, "prismatic", faces, middle, axis, by, note.ajar, tray)
    origin, axis = {
        "left": ((high[0], low[1], middle[2]), (0, 0, -1)),
        "right": ((high[0], high[1], middle[2]), (0, 0, 1)),
        "top": ((high[0], middle[1], high[2]), (0, -1, 0)),
        "bottom": ((high[0], middle[1], low[2]), (0, 1, 0)),
        "lid": ((low[0], middle[1], low[2]), (0, -1, 0)),
    }[note.opens]
    if note.axis is not None:
        origin = whole.min(axis=0) + np.array(note.axis) * np.ptp(whole, axis=0)
    by, ajar = np.deg2rad([_QUARTER_DEG if note.by is None else note.by, note.ajar]).tolist()
    return Link(note.name, "revolute", faces, np.array(origin), np.array(axis, float), by, ajar)


def _tagged(shape: Wavefront, note: Note) -> list[Link]:
    fixed: dict[tuple[str, str], list[int]] = {}
    moving: dict[tuple[str, str], list[int]] = {}
    for i, name in enumerate(shape.groups):
        tag = _TAG.match(name)
        if tag is not None:
            kept = moving if "_on_" in tag[1] else fixed
            kept.setdefault((tag[2], "" if tag[1] == "unique_" else tag[3] or ""), []).append(i)
    links = []
    for (kind, number), groups in sorted(moving.items()):
        pins = fixed.get((kind, number)) or fixed.get((kind, ""))
        if pins is None:
            raise ValueError(f"its groups name {kind} {number}, which is not there")
        faces, pin = np.isin(shape.group, groups), shape.points(np.isin(shape.group, pins))
        if not faces.any() or len(pin) == 0:
            raise ValueError(f"{kind} {number} has no faces")
        make = _on_hinge if kind == "hinge" else _on_rail
        links.append(make(f"part_{number}", shape, faces, pin, note))
    return links


def _middle(points: Float[np.ndarray, "M 3"]) -> Float[np.ndarray, "3"]:
    return (points.min(axis=0) + points.max(axis=0)) / 2


def _on_hinge(
    name: str, shape: Wavefront, faces: Bool[np.ndarray, " F"], pin: Float[np.ndarray, "M 3"], note: Note
) -> Link:
    origin, axis = _middle(pin), np.zeros(3)
    axis[int(np.ptp(pin, axis=0).argmax())] = 1.0
    leaf, whole = shape.points(faces), shape.vertices
    centre, size = _middle(leaf), np.ptp(leaf, axis=0)
    out, flat = centre - _middle(whole), size[2] < 0.5 * size[:2].min()
    if axis[2] == 0 and flat:
        wanted = np.array([0.0, 0, 1])  # a lid
    elif abs(out[0]) > 0.15 * np.ptp(whole[:, 0]):
        wanted = np.array([np.sign(out[0]), 0, 0])  # away from the body that it closes
    else:
        wanted = np.array([1.0 if origin[0] >= centre[0] - 1e-3 else -1.0, 0, 0])  # to the side of the pin
    if np.cross(axis, centre - origin) @ wanted < 0:
        axis = -axis
    by = _QUARTER_DEG if note.by is None else note.by
    opens_by, ajar = np.deg2rad([abs(by), note.ajar]).tolist()
    return Link(name, "revolute", faces, origin, axis * np.sign(by), opens_by, ajar)


def _on_rail(
    name: str, shape: Wavefront, faces: Bool[np.ndarray, " F"], pin: Float[np.ndarray, "M 3"], note: Note
) -> Link:
    leaf, along = shape.points(faces), int(np.ptp(pin, axis=0).argmax())
    below = leaf[:, along].min() - pin[:, along].min()
    above = pin[:, along].max() - leaf[:, along].max()
    axis = np.zeros(3)
    axis[along] = 1.0 if above >= below else -1.0
    return Link(name, "prismatic", faces, _middle(leaf), axis, float(max(above, below)), note.ajar)
