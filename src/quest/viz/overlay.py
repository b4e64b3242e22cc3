"""Overlay videos: what a tracker answered, drawn on the frames that it saw.

A panel at the side has the world tracks in 3D and a row per query with its joint and its confidence over time. A filled
mark is visible, a hollow one is not; a dashed grey one is held on its joint; a red cross is lost. Joints are drawn as
they are known at the end, in all frames: the axis of turning with the arc that was seen, or the line of sliding.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.spatial.transform import Rotation

from quest.data.video import frame_rate, write_video
from quest.errors import InputError
from quest.types import Clip, State, Tracks
from quest.viz import ink
from quest.viz.ink import (
    Canvas,
    draw_box,
    draw_cased_path,
    draw_disc,
    draw_line,
    draw_path,
    draw_ring,
    draw_text,
    fit_text,
)
from quest.viz.joint_lines import JointLines, joint_lines
from quest.viz.palette import BACKGROUND, HELD, LINE, LOST, MUTED, RGB, SURFACE, TEXT, query_colour

SMALLEST_HEIGHT_PX = 720
_NEAREST_M = 0.02
MOST_TAGS = 12
"""With more queries than this, tags on the picture carry numbers only; names stay in the panel."""
_INSET = 0.86
"""Height of the world's picture, of the width of the panel."""
_AXIS_COLOURS: tuple[RGB, ...] = ((255, 107, 107), (105, 219, 124), (92, 160, 255))
_TURNED = Rotation.from_euler("yx", [-32.0, 18.0], degrees=True).as_matrix()
"""First about y, then about x."""
_SMALLEST_BOX_M = 0.05
_CORNERS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)], dtype=np.float64)
_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if np.abs(_CORNERS[a] - _CORNERS[b]).sum() == 1]


def write_overlay(clip: Clip, tracks: Tracks, path: str | Path, *, trail_s: float = 1.0) -> None:
    """Write an overlay video (H.264, MP4), at least 720 pixels high.

    Args:
        clip: the frames that were tracked.
        tracks: the answers, one per frame of the clip.
        path: file to write; replaced if it exists.
        trail_s: how far back trails reach, seconds.

    Raises:
        InputError: clip and tracks are of different length.
    """
    painter = OverlayPainter(clip, tracks, trail_s=trail_s)
    write_video(Path(path), painter.frames(), frames_per_s=float(np.clip(frame_rate(clip.stamp_s), 1.0, 120.0)))


class OverlayPainter:
    """Draws single frames of an overlay; arguments and errors are those of :func:`write_overlay`."""

    def __init__(self, clip: Clip, tracks: Tracks, *, trail_s: float = 1.0) -> None:
        if len(clip) != len(tracks):
            raise InputError(
                f"overlay: clip {clip.name!r} has {len(clip)} frames, its tracks {len(tracks)}; track this clip"
            )
        self._clip, self._tracks, self._trail_s = clip, tracks, trail_s
        self._scale = max(1.0, SMALLEST_HEIGHT_PX / clip.camera.height)
        sides = (clip.camera.width, clip.camera.height)
        self._width, self._height = (2 * round(side * self._scale / 2) for side in sides)
        self._unit = self._height / 720
        self._panel = 2 * round(180 * self._unit)
        self._footer = 2 * round(18 * self._unit)
        self._uv = tracks.uv_px.astype(np.float64) * self._scale
        self._colours = [query_colour(k) for k in range(len(tracks.names))]
        self._held, self._lost = (np.asarray(tracks.state == state.value) for state in (State.HELD, State.LOST))
        self._joints = joint_lines(tracks)
        size = (self._panel, round(_INSET * self._panel))
        pose = clip.cam_from_world[0]
        self._inset = _Inset(tracks.point_world, pose, joints=self._joints, size=size, unit=self._unit)
        self._tag_side: dict[int, int] = {}
        self._still = self._draw_still()

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the frames, pixels."""
        return self._width + self._panel, self._height + self._footer

    def frames(self) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
        """All frames in order."""
        return map(self.frame, range(len(self._clip)))

    def frame(self, t: int) -> UInt8[np.ndarray, "H W 3"]:
        """Frame ``t``."""
        canvas = self._still.copy()
        picture = canvas[: self._height, : self._width]
        method = cv2.INTER_CUBIC if self._scale > 1 else cv2.INTER_AREA
        picture[:] = cv2.resize(self._clip.rgb[t], (self._width, self._height), interpolation=method)
        self._draw_joints(picture, t)
        self._draw_trails(picture, t)
        size = np.array([self._width, self._height])
        known = [k for k, uv in enumerate(self._uv[t]) if (uv > 0).all() and (uv < size).all()]  # NaN compares false
        for k in known:
            self._draw_mark(picture, tuple(self._uv[t, k]), t, k)
        self._draw_tags(picture, t, known)
        side = canvas[:, self._width :]
        colours = [LOST if lost else colour for lost, colour in zip(self._lost[t], self._colours, strict=True)]
        self._inset.draw_tracks(side[: round(_INSET * self._panel)], t, colours, self._tracks.visible)
        self._draw_rows(side, t)
        self._draw_footer(canvas, t)
        return canvas

    def _colour(self, t: int, k: int) -> RGB:
        return LOST if self._lost[t, k] else HELD if self._held[t, k] else self._colours[k]

    def _draw_still(self) -> Canvas:
        """Everything that is the same on all frames."""
        canvas, u = ink.blank(self._height + self._footer, self._width + self._panel), self._unit
        side = canvas[:, self._width :]
        inset = side[: round(_INSET * self._panel)]
        self._inset.draw_frame(inset)
        for joint, colour in zip(self._joints, self._colours, strict=True):
            if joint is not None:
                self._inset.draw_joint(inset, joint, colour)
        draw_text(side, "world", (14 * u, 18 * u), size=round(14 * u), colour=MUTED)
        draw_line(canvas, (self._width, self._height), (canvas.shape[1], self._height), colour=LINE)
        return canvas

    def _draw_joints(self, picture: Canvas, t: int) -> None:
        """Axis, arc or line of every joint that moves, with a dot at both ends of its range."""
        u = self._unit
        for joint, colour in zip(self._joints, self._colours, strict=True):
            if joint is None:
                continue
            for arm in joint.arms:
                a, b = self._pixels(arm, t)
                if np.isfinite((a, b)).all():
                    draw_line(picture, tuple(a), tuple(b), colour=colour, width=round(1.5 * u), opacity=0.5)
            if joint.axis is not None:
                draw_cased_path(picture, self._pixels(joint.axis, t), colour=colour, width=round(2.5 * u))
            path = self._pixels(joint.path, t)
            draw_cased_path(picture, path, colour=colour, width=round(2 * u))
            for end in path[[0, -1]]:
                if np.isfinite(end).all():
                    draw_disc(picture, tuple(end), 3.5 * u, colour=colour, edge=u)

    def _pixels(self, point_world: np.ndarray, t: int) -> np.ndarray:
        """Pixels of the picture of world points in a frame; NaN behind the camera."""
        pose = self._clip.cam_from_world[t]
        at = (point_world @ pose[:3, :3].T + pose[:3, 3]) @ self._clip.camera.matrix.T
        depth = np.where(at[:, 2:] > _NEAREST_M, at[:, 2:], np.nan)
        return at[:, :2] / depth * self._scale

    def _draw_trails(self, picture: Canvas, t: int) -> None:
        stamp_s = self._clip.stamp_s
        first = int(np.searchsorted(stamp_s, stamp_s[t] - self._trail_s))
        width = round(2.5 * self._unit)
        for k, s in np.ndindex(len(self._colours), t - first):
            s += first + 1
            a, b = self._uv[s - 1, k], self._uv[s, k]
            dashed = self._held[s, k] and s % 2  # every other piece is left out
            if dashed or not np.abs(a - b).max() > 0.3:  # resting, or NaN
                continue
            colour = HELD if self._held[s, k] or self._lost[s, k] else self._colours[k]
            opacity = 0.15 + 0.75 * (s - first) / (t - first)
            draw_line(picture, tuple(a), tuple(b), colour=colour, width=width, opacity=opacity)

    def _draw_mark(self, picture: Canvas, xy: tuple[float, ...], t: int, k: int, *, radius: float = 7.0) -> None:
        u, colour, centre = self._unit, self._colours[k], (xy[0], xy[1])
        radius, width = radius * u, round(2 * u)
        if self._lost[t, k]:
            arm = 0.8 * radius
            for colour, thickness in ((BACKGROUND, width + 3), (LOST, width + 1)):
                for sign in (1, -1):
                    a, b = (centre[0] - arm, centre[1] - sign * arm), (centre[0] + arm, centre[1] + sign * arm)
                    draw_line(picture, a, b, colour=colour, width=thickness)
        elif self._held[t, k]:
            draw_disc(picture, centre, 0.5 * radius, colour=colour, edge=1.5 * u)
            draw_ring(picture, centre, 1.35 * radius, colour=HELD, width=width, dashes=5, edge=1)
        elif self._tracks.visible[t, k]:
            draw_disc(picture, centre, radius + 1.2 * u, colour=(255, 255, 255), edge=1.3 * u)
            draw_disc(picture, centre, radius - 0.8 * u, colour=colour)
        else:
            draw_ring(picture, centre, radius, colour=colour, width=width, edge=1)

    def _tag_text(self, t: int, k: int) -> str:
        if len(self._colours) > MOST_TAGS:
            return str(k)
        return f"{fit_text(self._name(k), round(15 * self._unit), 150 * self._unit)}  {self._doing(t, k)}"

    def _doing(self, t: int, k: int) -> str:
        return "lost" if self._lost[t, k] else "held" if self._held[t, k] else f"{self._tracks.confidence[t, k]:.2f}"

    def _name(self, k: int) -> str:
        name, label = self._tracks.names[k] or f"query {k}", self._tracks.labels[k]
        return name if not label or label in name else f"{name} ({label})"

    def _draw_tags(self, picture: Canvas, t: int, known: list[int]) -> None:
        """Place a tag beside every mark where it covers least; a tag moves only if that frees something."""
        u = self._unit
        size, height = round(15 * u), 22 * u
        paths = [xy for joint in self._joints if joint for xy in self._pixels(joint.path[::6], t)]
        marks = [(self._uv[t, k], 9 * u) for k in known] + [(xy, 6 * u) for xy in paths if np.isfinite(xy).all()]
        taken = [(*(xy - reach), *(xy + reach)) for xy, reach in marks]
        for k in known:
            text = self._tag_text(t, k)
            # Digits differ in width: rounding up keeps the box from trembling.
            width = -(-ink.text_size(text, size)[0] // 8) * 8 + 26 * u
            boxes = _boxes(self._uv[t, k], width, height, u, (self._width, self._height))
            costs = [sum(_overlap(box, other) for other in taken) for box in boxes]
            kept = self._tag_side.get(k)
            best = int(np.argmin(costs))
            if kept is not None and costs[kept] <= costs[best] + 0.1 * width * height:
                best = kept
            self._tag_side[k] = best
            x0, y0, x1, y1 = boxes[best]
            taken.append(boxes[best])
            colour = self._colour(t, k)
            if best >= 4:  # far from its mark: a leader shows whose it is
                near = (float(np.clip(self._uv[t, k][0], x0, x1)), float(np.clip(self._uv[t, k][1], y0, y1)))
                draw_line(picture, tuple(self._uv[t, k]), near, colour=colour, width=round(u), opacity=0.8)
            draw_box(picture, x0, y0, x1 - x0, height, colour=BACKGROUND, opacity=0.78, radius=round(6 * u))
            draw_box(picture, x0 + 7 * u, y0 + 7 * u, 8 * u, 8 * u, colour=colour, radius=round(4 * u))
            draw_text(picture, text, (x0 + 20 * u, y0 + height / 2), size=size, colour=TEXT)

    def _draw_rows(self, side: Canvas, t: int) -> None:
        """One row per query: its mark, name, confidence now and until now."""
        u = self._unit
        top, bottom = _INSET * self._panel + 8 * u, self._height - 6 * u
        queries = len(self._colours)
        row = float(np.clip((bottom - top) / max(queries, 1), 22 * u, 46 * u))
        shown = int((bottom - top) // row)
        if shown < queries:
            shown -= 1
            draw_text(side, f"and {queries - shown} more", (16 * u, bottom - row / 2), size=round(13 * u), colour=MUTED)
        for k in range(min(shown, queries)):
            self._draw_row(side, t, k, top + (k + 0.5) * row, row)

    def _draw_row(self, side: Canvas, t: int, k: int, middle: float, row: float) -> None:
        u = self._unit
        size, small, name_width = round(15 * u if row > 30 * u else 13 * u), round(12 * u), self._panel - 196 * u
        box = (8 * u, middle - row / 2 + 2 * u, self._panel - 16 * u, row - 4 * u)
        draw_box(side, *box, colour=SURFACE, radius=round(7 * u))
        bound = bool(np.isfinite(self._uv[t, k]).all())
        if bound:
            self._draw_mark(side, (24 * u, middle), t, k, radius=5.5)
        joint = self._coordinate(t, k)
        two_lines = bool(joint) and row > 38 * u
        at = (40 * u, middle - 8 * u * two_lines)
        draw_text(side, self._name(k), at, size=size, colour=TEXT if bound else MUTED, width=name_width)
        if two_lines:
            draw_text(side, joint, (40 * u, middle + 11 * u), size=small, colour=MUTED, width=name_width)
        value = self._doing(t, k) if bound else "none yet"
        colour = {"none yet": MUTED, "lost": LOST, "held": HELD}.get(value, TEXT)
        self._draw_curve(side, k, t, (self._panel - 152 * u, middle - row * 0.3), (80 * u, row * 0.6))
        draw_text(side, value, (self._panel - 18 * u, middle), size=size, colour=colour, align="right")

    def _coordinate(self, t: int, k: int) -> str:
        """Where on its joint a query is, and the range; empty where it has none that moves."""
        if self._tracks.joints is None or self._joints[k] is None:
            return ""
        return self._tracks.joints.describe(k, t).partition(" ")[2]  # the unit tells the kind

    def _draw_curve(self, side: Canvas, k: int, t: int, at: tuple[float, float], size: tuple[float, float]) -> None:
        """Confidence from the first frame to ``t``, on an axis that is as long as the clip."""
        draw_line(side, (at[0], at[1] + size[1]), (at[0] + size[0], at[1] + size[1]), colour=LINE)
        last, columns = max(len(self._tracks) - 1, 1), round(size[0])
        frames = np.unique(np.linspace(0, last, columns).astype(int))
        frames = frames[frames <= t]
        confidence = np.clip(np.nan_to_num(self._tracks.confidence[frames, k].astype(np.float64)), 0, 1)
        x, y = at[0] + size[0] * frames / last, at[1] + size[1] * (1 - confidence)
        for i, f in list(enumerate(frames.tolist()))[1:]:
            width = round(1.3 * self._unit)
            draw_line(side, (x[i - 1], y[i - 1]), (x[i], y[i]), colour=self._colour(f, k), width=width)

    def _draw_footer(self, canvas: Canvas, t: int) -> None:
        u, frames = self._unit, len(self._clip)
        middle, size = self._height + self._footer / 2, round(14 * u)
        digits = len(str(frames - 1))
        when = f"frame {t:0{digits}d} / {frames - 1}    {self._clip.stamp_s[t]:.2f} s"
        draw_text(canvas, when, (canvas.shape[1] - 14 * u, middle), size=size, colour=TEXT, align="right")
        room = canvas.shape[1] - ink.text_size(when, size)[0] - 44 * u
        left = "    ".join((self._clip.name, *self._tracks.frame_flags))
        draw_text(canvas, left, (14 * u, middle), size=size, colour=MUTED, width=room)
        done = canvas.shape[1] * (t + 1) / frames
        draw_box(canvas, 0, self._height, done, max(2, 2 * u), colour=query_colour(0))


class _Inset:
    """An orthographic view of world tracks, turned a little from the camera's own view so that depth shows.

    Its box takes in all points that will ever be drawn, metres, and the joints that are not far away. ``size`` is width
    and height in pixels, ``unit`` the scale of lines and letters.
    """

    def __init__(
        self,
        point_world: Float[np.ndarray, "T K 3"],
        cam_from_world: Float[np.ndarray, "4 4"],
        *,
        joints: Sequence[JointLines | None],
        size: tuple[int, int],
        unit: float,
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
        for name, along, colour in zip("xyz", self._rotation.T, _AXIS_COLOURS, strict=True):
            tip = origin + along * 30 * self._unit
            draw_line(canvas, tuple(origin), tuple(tip), colour=colour, width=round(2 * self._unit))
            label = tip + 9 * self._unit * along / max(float(np.linalg.norm(along)), 0.3)
            draw_text(canvas, name, tuple(label), size=round(13 * self._unit), colour=colour, align="centre")
        text = " x ".join(f"{edge:.2f}" for edge in self._high - self._low) + " m"
        at = (canvas.shape[1] - 10 * self._unit, canvas.shape[0] - 12 * self._unit)
        draw_text(canvas, text, at, size=round(12 * self._unit), colour=MUTED, align="right")

    def draw_joint(self, canvas: Canvas, joint: JointLines, colour: RGB) -> None:
        """Draw the axis of a joint and the path over its range."""
        if joint.axis is not None:
            axis = self.project(joint.axis)
            draw_line(canvas, tuple(axis[0]), tuple(axis[1]), colour=colour, width=round(1.5 * self._unit))
        for arm in map(self.project, joint.arms):
            draw_line(canvas, tuple(arm[0]), tuple(arm[1]), colour=colour, opacity=0.4)
        draw_path(canvas, self.project(joint.path), colour=colour, width=round(2 * self._unit))

    def draw_tracks(self, canvas: Canvas, t: int, colours: list[RGB], visible: Bool[np.ndarray, "T K"]) -> None:
        """Draw every path up to frame ``t`` and a mark where it is at ``t``: filled where visible, else hollow."""
        for k, colour in enumerate(colours):
            path = self._xy[: t + 1, k]
            draw_path(canvas, path, colour=colour, width=round(self._unit))
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


def _boxes(
    uv: np.ndarray, width: float, height: float, u: float, size: tuple[int, int]
) -> list[tuple[float, float, float, float]]:
    """Places of a tag round a mark, inside the picture: four near ones, then four farther ones."""
    boxes = []
    for gap in (13 * u, 40 * u):
        for x in (uv[0] + gap, uv[0] - gap - width):
            for y in (uv[1] - gap - height / 2, uv[1] + gap - height / 2):
                left = min(max(float(x), 3.0), size[0] - width - 3)
                top = min(max(float(y), 3.0), size[1] - height - 3)
                boxes.append((left, top, left + width, top + height))
    return boxes


def _overlap(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    """Shared area of two boxes, pixels squared."""
    return max(0.0, min(a[2], b[2]) - max(a[0], b[0])) * max(0.0, min(a[3], b[3]) - max(a[1], b[1]))
