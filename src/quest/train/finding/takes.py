"""Marks of simulated frames: what of every entity is seen, and the doors and drawers that are closed."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from quest.model.finder import OPENINGS, PANELS, PLACES
from quest.train.finding.marks import KINDS, UNKNOWN, Marks
from quest.types import GRIPS, Take, View

_PANEL_OF = {"StorageFurniture": "cabinet", "Table": "cabinet", "Refrigerator": "refrigerator", "Door": "door"}
"""What doors and drawers are called, by the object's category; those of others are not labelled in pictures."""
_CLOSED = 0.1
"""A panel's outline is its face where its joint is opened by at most this share of its range."""
_LEAST_PX = 2


def marks_of(take: Take, view: View, t: int) -> Marks:
    """What is seen in a frame of a view."""
    rows: list[tuple[int, np.ndarray, np.ndarray, int, int, int]] = []
    for e, entity in enumerate(take.info.entities):
        if not view.visible[t, e]:
            continue
        label, lift, at = entity.label, int(entity.fixed), view.uv_px[t, e].astype(float)
        if label in GRIPS:
            box = _outline(view.entity_id[t] == 1 + e)
            if box is not None:
                rows.append(
                    (PLACES.index("grip"), box, np.clip(at, box[:2], box[2:]), int(label == "knob"), lift, UNKNOWN)
                )
        else:
            rows.append(
                (PLACES.index(label), np.tile(at, 2), at, UNKNOWN, lift if label != "hinge" else UNKNOWN, UNKNOWN)
            )
    panel = _PANEL_OF.get(take.info.category)
    known = np.zeros(len(KINDS), bool)
    known[: len(PLACES)] = True
    if panel is not None and _closed(take, t):
        known[len(PLACES) :] = True
        carriers = {e.link: e.joint for e in take.info.entities if not e.fixed and e.label != "hinge"}
        for link, joint in carriers.items():
            box = _outline(view.link_id[t] == 1 + link)
            if box is not None:
                kind = len(PLACES) + PANELS.index(panel)
                middle = (box[:2] + box[2:]) / 2
                rows.append((kind, box, middle, UNKNOWN, UNKNOWN, _opening(take, view, t, joint, box)))
    kind, box, point, knob, lift, opening = zip(*rows, strict=True) if rows else ((),) * 6
    as_int = [np.array(values, np.int64) for values in (kind, knob, lift, opening)]
    where = np.array(box, np.float64).reshape(-1, 4), np.array(point, np.float64).reshape(-1, 2)
    return Marks(as_int[0], *where, *as_int[1:], known=known)


def _closed(take: Take, t: int) -> bool:
    joints = take.info.joints
    span = np.array([j.upper - j.lower for j in joints])
    moved = np.abs(take.joint_position[t] - take.joint_position[0])
    return bool((moved <= _CLOSED * np.where(span > 0, span, np.inf)).all())


def _outline(mask: np.ndarray) -> Float[np.ndarray, "4"] | None:
    """Edges of a mask, None where hardly anything is seen."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if len(rows) < _LEAST_PX or len(columns) < _LEAST_PX:
        return None
    return np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1], float)


def _opening(take: Take, view: View, t: int, joint: int, box: Float[np.ndarray, "4"]) -> int:
    """How a panel opens, as seen from the camera."""
    if take.info.joints[joint].kind == "prismatic":
        return OPENINGS.index("slides")
    origin, axis = np.split(take.joint_axis[t, joint].astype(float), 2)
    pose, camera = view.clip.cam_from_world[t], view.clip.camera
    ends = np.stack((origin - 0.05 * axis, origin + 0.05 * axis)) @ pose[:3, :3].T + pose[:3, 3]
    if (ends[:, 2] <= 0).any():
        return UNKNOWN
    u, v = camera.fx * ends[:, 0] / ends[:, 2] + camera.cx, camera.fy * ends[:, 1] / ends[:, 2] + camera.cy
    along = np.array([u[1] - u[0], v[1] - v[0]])
    middle, centre = np.array([u.mean(), v.mean()]), np.array([box[0] + box[2], box[1] + box[3]]) / 2
    if abs(along[1]) > abs(along[0]):
        return OPENINGS.index("left" if middle[0] < centre[0] else "right")
    return OPENINGS.index("top" if middle[1] < centre[1] else "bottom")
