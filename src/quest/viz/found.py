"""A picture with what can be taken hold of in it."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import UInt8

from quest.model.finder import OPENINGS
from quest.model.found import LABELS_FOUND, Found
from quest.viz.ink import draw_outlined
from quest.viz.palette import MUTED, query_colour


def draw_found(
    rgb: UInt8[np.ndarray, "H W 3"], found: Found, *, least: float, all_panels: bool = True
) -> UInt8[np.ndarray, "H W 3"]:
    """The picture with boxes of handles and knobs, dots of the rest, and the doors and drawers that carry them.

    Args:
        rgb: the picture.
        found: what was found in it.
        least: probability below which nothing is drawn.
        all_panels: whether doors and drawers are drawn too that carry none of what is drawn.
    """
    canvas = np.ascontiguousarray(rgb).copy()
    unit = max(canvas.shape[:2]) / 640
    thick, size = max(1, round(1.5 * unit)), max(9, round(11 * unit))
    shown = np.flatnonzero(found.p >= least)
    panels = found.panels
    carriers = set(found.panel[shown].tolist()) | set(np.flatnonzero((panels.logit > 0) & all_panels).tolist())
    for k in sorted(carriers - {-1}):
        left, top, right, bottom = panels.box_px[k].round().astype(int).tolist()
        cv2.rectangle(canvas, (left, top), (right, bottom), MUTED, thick, cv2.LINE_AA)
        opening = OPENINGS[int(panels.opening_p[k].argmax())]
        hinge = {
            "left": ((left, top), (left, bottom)), "right": ((right, top), (right, bottom)),
            "top": ((left, top), (right, top)), "bottom": ((left, bottom), (right, bottom)),
        }.get(opening)  # fmt: skip
        if hinge is not None:
            cv2.line(canvas, *hinge, query_colour(LABELS_FOUND.index("hinge")), 3 * thick, cv2.LINE_AA)
    for i in shown[::-1]:
        label = found.labels[i]
        colour = query_colour(LABELS_FOUND.index(label))
        x, y = found.uv_px[i].round().astype(int).tolist()
        if np.isnan(found.box_px[i, 0]):
            cv2.circle(canvas, (x, y), 3 * thick, colour, -1, cv2.LINE_AA)
            top = y - 4 * thick
        else:
            left, top, right, bottom = found.box_px[i].round().astype(int).tolist()
            cv2.rectangle(canvas, (left, top), (right, bottom), colour, 2 * thick, cv2.LINE_AA)
        draw_outlined(canvas, f"{label} {found.p[i]:.2f}", (x, top - size * 0.8), size=size, align="centre")
    return canvas
