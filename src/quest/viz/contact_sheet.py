"""Contact sheets: one picture of a take in which a person sees whether its ground truth is right; or of many takes.

Each view has a row of frames, with the outlines of links, the masks of entities tinted and the entities' true pixels
marked (filled where visible, hollow where not), and a row of depth. Below are the entities and the joints over time.
The sheet of many takes has one such row of frames for each.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import UInt8

from quest.errors import InputError
from quest.types import Take, View
from quest.viz import ink
from quest.viz.ink import Canvas, draw_box, draw_disc, draw_entity, draw_line, draw_path, draw_text, grid
from quest.viz.palette import LINE, MUTED, RGB, SURFACE, TEXT, entity_colours, query_colour

_MARGIN, _GAP, _HEAD, _NAME, _ROW = 24, 6, 96, 30, 26
_TINT = 0.5


def contact_sheet(
    take: Take, *, columns: int = 8, tile_width_px: int = 288, every: int = 1
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw a take as one picture.

    Args:
        take: what to draw; with at least one view.
        columns: frames to show, spread evenly from the first to the last.
        tile_width_px: width of each frame on the sheet.
        every: of a longer take, these are every n-th frame; for the numbers of frames.

    Raises:
        InputError: the take has no views, or fewer than one column or pixel is asked for.
    """
    if not take.views or columns < 1 or tile_width_px < 16:
        raise InputError(
            f"contact sheet of {take.info.name!r}: expected a view, a column and tiles of 16 pixels, "
            f"got {len(take.views)}, {columns} and {tile_width_px}"
        )
    shown = _shown(take, columns)
    colours = entity_colours(entity.label for entity in take.info.entities)
    near_m, far_m = _depth_range(take)
    rows: list[Canvas] = []
    for v, view in enumerate(take.views):
        size = f"{view.clip.camera.width} x {view.clip.camera.height} px"
        rows.append(_frames_row(take, v, shown, tile_width_px, f"view {v}    {size}    {_camera_motion(view)}"))
        if view.clip.depth_m is not None:
            tiles = [_draw_depth(view.clip.depth_m[t], near_m, far_m, tile_width_px) for t in shown]
            words = f"view {v}    depth, {near_m:.2f} m red to {far_m:.2f} m blue, black where missing"
            rows.append(_row(tiles, words))
    width = max(rows[0].shape[1], 900)
    foot = _draw_foot(take, shown, colours, width)
    sheet = grid([[part] for part in (*rows, foot)], head=_HEAD, foot=_MARGIN, sides=_MARGIN)
    _draw_head(sheet[:_HEAD], take, shown, tile_width_px, every)
    return sheet


def takes_sheet(
    takes: Sequence[Take], *, title: str, columns: int = 8, tile_width_px: int = 224
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw several takes as one picture, below what they have in common: a row of frames of the first view of each.

    Columns and widths are as for :func:`contact_sheet`; a few frames of each take are enough.

    Raises:
        InputError: there is no take, one has no views, or fewer than one column or pixel is asked for.
    """
    if not takes or not all(take.views for take in takes) or columns < 1 or tile_width_px < 16:
        raise InputError(
            f"contact sheet {title!r}: expected takes with views, a column and tiles of 16 pixels, "
            f"got {len(takes)} takes, {columns} and {tile_width_px}"
        )
    rows = []
    for take in takes:
        info = take.info
        suite = " ".join(str(word) for word in (info.suite, info.provenance.get("variant", "")) if word)
        facts = (info.name, info.category, suite, f"level {info.level}", f"{take.stamp_s[-1]:.1f} s")
        words = "    ".join((*facts, _camera_motion(take.views[0])))
        rows.append([_frames_row(take, 0, _shown(take, columns), tile_width_px, words)])
    sheet = grid(rows, head=_HEAD - 40, foot=_MARGIN, sides=_MARGIN, least_width=600)
    draw_text(sheet, title, (_MARGIN, 28), size=24, colour=TEXT, width=sheet.shape[1] - 2 * _MARGIN)
    return sheet


def _shown(take: Take, columns: int) -> list[int]:
    """Frames, spread evenly from the first to the last."""
    return np.unique(np.linspace(0, len(take) - 1, columns).round().astype(int)).tolist()


def _depth_range(take: Take) -> tuple[float, float]:
    """Depth between which colours are spread, the same for all views."""
    known = [view.clip.depth_m[::4, ::4, ::4] for view in take.views if view.clip.depth_m is not None]
    valid = [depth_m[depth_m > 0] for depth_m in known]
    if not any(map(len, valid)):
        return 1.0, 2.0
    near_m, far_m = np.percentile(np.concatenate(valid), [1, 99])
    return float(near_m), float(max(far_m, near_m + 1e-3))


def _tile(image: np.ndarray, width: int, method: int) -> np.ndarray:
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    return cv2.resize(image, (width, height), interpolation=method)


def _draw_frame(view: View, t: int, colours: list[RGB], tracked: np.ndarray, width: int) -> Canvas:
    shrinks = width < view.clip.camera.width
    tile = _tile(view.clip.rgb[t], width, cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)
    mask = _tile(view.entity_id[t], width, cv2.INTER_NEAREST)
    lookup = np.array([(0, 0, 0), *colours], dtype=np.float32)
    inside = mask > 0
    tile[inside] = np.rint(tile[inside] * (1 - _TINT) + lookup[mask[inside]] * _TINT).astype(np.uint8)
    links = _tile(view.link_id[t], width, cv2.INTER_NEAREST)
    edge = np.zeros(links.shape, dtype=bool)
    edge[:, 1:] |= links[:, 1:] != links[:, :-1]
    edge[1:] |= links[1:] != links[:-1]
    tile[edge] = np.rint(tile[edge] * 0.5 + 127).astype(np.uint8)
    scale = width / view.clip.camera.width
    size = np.array([width, len(tile)])
    for e, colour in enumerate(colours):
        uv = view.uv_px[t, e].astype(np.float64) * scale
        if ((uv > 0) & (uv < size)).all():  # NaN compares false
            radius, seen = 3.5 if e in tracked else 2.5, bool(view.visible[t, e])
            draw_entity(tile, (float(uv[0]), float(uv[1])), str(e), radius=radius, colour=colour, visible=seen)
    return tile


def _draw_depth(depth_m: np.ndarray, near_m: float, far_m: float, width: int) -> Canvas:
    depth_m = _tile(depth_m, width, cv2.INTER_NEAREST)
    # Even steps of inverse depth: the object keeps most of the colours however far the background is.
    inverse = 1 / np.maximum(depth_m, 1e-6)
    nearness = np.clip((inverse - 1 / far_m) / (1 / near_m - 1 / far_m), 0, 1)
    tile = cv2.applyColorMap(np.rint(nearness * 255).astype(np.uint8), cv2.COLORMAP_TURBO)[..., ::-1].copy()
    tile[depth_m <= 0] = 0
    return tile


def _frames_row(take: Take, v: int, shown: list[int], width: int, words: str) -> Canvas:
    colours = entity_colours(entity.label for entity in take.info.entities)
    return _row([_draw_frame(take.views[v], t, colours, take.tracked, width) for t in shown], words)


def _row(tiles: list[Canvas], name: str) -> Canvas:
    row = grid([tiles], gap=_GAP, head=_NAME, foot=_GAP)
    draw_text(row, name, (0, _NAME / 2 + 2), size=14, colour=MUTED, width=row.shape[1])
    return row


def _camera_motion(view: View) -> str:
    """How far the camera comes from where it was first, and how far it turns, in words."""
    pose = view.clip.cam_from_world
    centre = -np.einsum("tji,tj->ti", pose[:, :3, :3], pose[:, :3, 3])
    moved_m = float(np.linalg.norm(centre - centre[0], axis=-1).max())
    cosine = (np.einsum("tij,ij->t", pose[:, :3, :3], pose[0, :3, :3]) - 1) / 2
    turned_deg = float(np.rad2deg(np.arccos(np.clip(cosine.min(), -1, 1))))
    if moved_m < 1e-6 and turned_deg < 0.01:
        return "camera at rest"
    return f"camera moves up to {moved_m:.2f} m and turns {turned_deg:.1f} deg"


def _draw_head(head: Canvas, take: Take, shown: list[int], tile_width: int, every: int) -> None:
    info = take.info
    room = head.shape[1] - 2 * _MARGIN
    draw_text(head, info.name, (_MARGIN, 28), size=24, colour=TEXT, width=room)
    suite = [f"suite {info.suite}"] if info.suite != "standard" else []
    facts = (
        f"{info.category} {info.object_id} ({info.source})", f"level {info.level}", *suite, f"seed {info.seed}",
        f"{len(take)} frames at {info.frames_per_s / every:g}/s", f"half diagonal {info.half_diagonal_m:.3f} m",
    )  # fmt: skip
    draw_text(head, "    ".join(facts), (_MARGIN, 56), size=15, colour=MUTED, width=room)
    for i, t in enumerate(shown):
        x = _MARGIN + i * (tile_width + _GAP) + tile_width / 2
        label = f"frame {t * every}   {take.stamp_s[t]:.2f} s"
        draw_text(head, label, (x, 84), size=13, colour=TEXT, align="centre", width=tile_width)


def _draw_foot(take: Take, shown: list[int], colours: list[RGB], width: int) -> Canvas:
    """Left the entities, right the joints over time."""
    foot = ink.blank(_NAME + max(len(colours), 7) * _ROW + _MARGIN, width)
    left = round(0.55 * width)
    _draw_entities(foot[:, :left], take, colours)
    _draw_joints(foot[:, left + _MARGIN :], take, shown)
    return foot


def _draw_entities(area: Canvas, take: Take, colours: list[RGB]) -> None:
    joint_x, moves_x, seen_x = (share * area.shape[1] for share in (0.46, 0.62, 0.8))
    for x, title in ((0, "entity"), (joint_x, "joint"), (moves_x, "moves at most"), (seen_x, "seen in views")):
        draw_text(area, title, (x, _NAME / 2 + 4), size=13, colour=MUTED)
    moves = np.linalg.norm(take.point_world - take.point_world[:1], axis=-1).max(axis=0)
    for e, entity in enumerate(take.info.entities):
        y = _NAME + (e + 0.5) * _ROW
        draw_disc(area, (8, y), 5, colour=colours[e])
        kind = "fixed" if entity.fixed else take.info.joints[entity.joint].kind
        reach = f"{moves[e]:.2f} m = {moves[e] / take.info.half_diagonal_m:.2f}"
        seen = "   ".join(f"{100 * view.visible[:, e].mean():.0f} %" for view in take.views)
        draw_text(area, f"{e}   {entity.name}", (22, y), size=14, colour=TEXT, width=joint_x - 30)
        draw_text(area, kind, (joint_x, y), size=14, colour=TEXT)
        draw_text(area, reach, (moves_x, y), size=14, colour=TEXT if take.moved[e] else MUTED)
        draw_text(area, seen, (seen_x, y), size=14, colour=TEXT, width=area.shape[1] - seen_x)


def _draw_joints(area: Canvas, take: Take, shown: list[int]) -> None:
    """Every joint's position between its limits; vertical lines are the frames shown."""
    draw_text(area, "joints, lower to upper limit", (0, _NAME / 2 + 4), size=13, colour=MUTED)
    width, top, height = area.shape[1] - 8, _NAME + 4, 7 * _ROW - 8
    draw_box(area, 0, top, width, height, colour=SURFACE, radius=6)
    x = 10 + (width - 20) * np.arange(len(take)) / max(len(take) - 1, 1)
    for t in shown:
        draw_line(area, (x[t], top + 6), (x[t], top + height - 6), colour=LINE)
    for j, joint in enumerate(take.info.joints):
        share = (take.joint_position[:, j] - joint.lower) / max(joint.upper - joint.lower, 1e-9)
        y = top + height - 12 - (height - 24) * np.clip(share.astype(np.float64), -0.05, 1.05)
        moved_by = [e for e, entity in enumerate(take.info.entities) if entity.joint == j]
        colour = query_colour(moved_by[0]) if moved_by and j in take.info.moved_joints else MUTED
        draw_path(area, np.stack([x, y], axis=-1), colour=colour, width=2)
