"""A small 3D picture of world tracks: a box with the world's axes, joints, the paths so far, and where they are now."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from quest.viz.ink import Canvas, draw_disc, draw_line, draw_path, draw_ring, draw_text
from quest.viz.joint_lines import JointLines
from quest.viz.palette import LINE, MUTED, RGB, TEXT

AXIS_COLOURS: tuple[RGB, ...] = ((255, 107, 107), (105, 219, 124), (92, 160, 255))
_TURNED = Rotation.from_euler("yx", [-32.0, 18.0], degrees=True).as_matrix()
"""First about y, then about x."""
_SMALLEST_BOX_M = 0.05
_CORNERS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)], dtype=np.float64)
_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if np.abs(_CORNERS[a] - _CORNERS[b]).sum() == 1]


class Inset:
    """An orthographic view of world tracks, turned a little from the camera's own view so that depth shows.

    Args:
        point_world: all points that will ever be drawn, metres; NaN where there is none.
        cam_from_world: pose of the camera that the view is turned from.
        joints: lines of joints, of which the box takes in what is not far away.
        size: width and height, pixels.
        unit: scale of lines and letters; 1 suits a picture 720 pixels high.
    """

    def __init__(
        self,
        point_world: Float[np.ndarray, "T K 3"],
        cam_from_world: Float[np.ndarray, "4 4"],
        *,
        joints: Sequence[JointLines | None] = (),
        size: tuple[int, int],
        unit: float = 1.0,
    ) -> None:
        self._unit = unit
        lines = [line for joint in joints if joint for line in (joint.path, joint.axis) if line is not None]
        self._low, self._high = _bounds(point_world, lines)
        self._rotation = (_TURNED @ cam_from_world[:3, :3])[:2]
        corners = self._box() @ self._rotation.T
        margin = 26 * unit
        extent = np.maximum(np.ptp(corners, axis=0), 1e-9)
        self._px_per_m = float(((np.array(size) - 2 * margin) / extent).min())
        self._offset = np.array(size) / 2 - self._px_per_m * (corners.min(axis=0) + corners.max(axis=0)) / 2
        self._xy = self.project(point_world.astype(np.float64))

    def project(self, point_world: Float[np.ndarray, "*B 3"]) -> Float[np.ndarray, "*B 2"]:
        """Pixels of the inset; NaN stays NaN."""
        return point_world @ self._rotation.T * self._px_per_m + self._offset

    def draw_frame(self, canvas: Canvas) -> None:
        """Draw what never changes: the box, the axes at its lowest corner, and the length of its longest edge."""
        corners = self.project(self._box())
        for a, b in _EDGES:
            draw_line(canvas, tuple(corners[a]), tuple(corners[b]), colour=LINE)
        origin = corners[0]
        for name, along, colour in zip("xyz", self._rotation.T, AXIS_COLOURS, strict=True):
            tip = origin + along * 30 * self._unit
            draw_line(canvas, tuple(origin), tuple(tip), colour=colour, width=max(2, round(2 * self._unit)))
            label = tip + 9 * self._unit * along / max(float(np.linalg.norm(along)), 0.3)
            draw_text(canvas, name, tuple(label), size=round(13 * self._unit), colour=colour, align="centre")
        text = " x ".join(f"{edge:.2f}" for edge in self._high - self._low) + " m"
        at = (canvas.shape[1] - 10 * self._unit, canvas.shape[0] - 12 * self._unit)
        draw_text(canvas, text, at, size=round(12 * self._unit), colour=MUTED, align="right")

    def draw_joint(self, canvas: Canvas, joint: JointLines, colour: RGB) -> None:
        """Draw the axis of a joint and the path over its range."""
        if joint.axis is not None:
            axis = self.project(joint.axis)
            draw_line(canvas, tuple(axis[0]), tuple(axis[1]), colour=colour, width=max(1, round(1.5 * self._unit)))
        for arm in map(self.project, joint.arms):
            draw_line(canvas, tuple(arm[0]), tuple(arm[1]), colour=colour, opacity=0.4)
        draw_path(canvas, self.project(joint.path), colour=colour, width=max(2, round(2 * self._unit)))

    def draw_tracks(self, canvas: Canvas, t: int, colours: list[RGB], visible: Bool[np.ndarray, "T K"]) -> None:
        """Draw every path up to frame ``t`` and a mark where it is at ``t``: filled where visible, else hollow."""
        for k, colour in enumerate(colours):
            path = self._xy[: t + 1, k]
            draw_path(canvas, path, colour=colour, width=max(1, round(self._unit)))
            if np.isfinite(path[t]).all():
                radius = 4 * self._unit
                draw_disc(canvas, tuple(path[t]), radius, colour=colour if visible[t, k] else (20, 22, 26))
                draw_ring(canvas, tuple(path[t]), radius, colour=TEXT if visible[t, k] else colour)

    def _box(self) -> np.ndarray:
        return self._low + _CORNERS * (self._high - self._low)


def _bounds(point_world: np.ndarray, lines: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Corners of a box round the points and what is near of lines; a few wild points may fall outside."""
    points = point_world[np.isfinite(point_world).all(axis=-1)].astype(np.float64)
    if len(points) == 0:
        return np.zeros(3), np.ones(3)
    low, high = np.percentile(points, [1, 99], axis=0)
    reach = max(float((high - low).max()), _SMALLEST_BOX_M)
    for line in lines:
        if (line > low - reach).all() and (line < high + reach).all():
            low, high = np.minimum(low, line.min(axis=0)), np.maximum(high, line.max(axis=0))
    centre, half = (low + high) / 2, np.maximum((high - low) * 0.55, _SMALLEST_BOX_M / 2)
    half = np.maximum(half, half.max() / 4)  # a box, not a plate
    return centre - half, centre + half
