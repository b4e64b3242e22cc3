"""Takes in Rerun: images, depth as 3D points, entities and their trails, joint axes, cameras, masks, joint positions.

Below ``world`` are ``entities``, ``trails`` (of the last second), ``joints`` (their axes) and one ``view_N`` per
camera, whose ``image`` holds ``rgb``, ``depth``, ``links`` and ``entities``; below ``joints`` is one curve per joint.
Timelines are ``frame`` and ``time``.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np

from quest.data.take_format import DEPTH_SCALE_M, encode_depth
from quest.errors import ConfigError
from quest.extras import require
from quest.types import LABELS, Take, View
from quest.viz.palette import HELD, LINE, MUTED, RGB, query_colour
from quest.whole_file import whole_file

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

APPLICATION = "quest-take"
TRAIL_S = 1.0
_JPEG_QUALITY = 90


def save_rrd(take: Take, path: str | Path, *, every: int = 1) -> None:
    """Write a take as a Rerun recording, all or nothing.

    Args:
        take: the take.
        path: file to write, ``.rrd`` by custom; its folder is made.
        every: of a longer take, these are every n-th frame; for the numbers of frames.

    Raises:
        MissingExtraError: the extra ``viz`` is not installed.
    """
    recording = new_recording(APPLICATION, take.info.name)
    with whole_file(Path(path)) as partial:
        recording.save(partial, default_blueprint=take_blueprint(take))
        log_take(take, recording, every=every)
        recording.flush()
        recording.disconnect()


def open_viewer(take: Take, *, every: int = 1) -> None:
    """Open Rerun's viewer, or the one that is open, on a take.

    Args:
        take: the take.
        every: of a longer take, these are every n-th frame; for the numbers of frames.

    Raises:
        ConfigError: there is no screen.
        MissingExtraError: the extra ``viz`` is not installed.
    """
    recording = new_recording(APPLICATION, take.info.name)
    check_screen()
    recording.spawn(default_blueprint=take_blueprint(take))
    log_take(take, recording, every=every)
    recording.flush()


def log_take(take: Take, recording: rr.RecordingStream, *, every: int = 1) -> None:
    """Log everything of a take.

    Args:
        take: the take.
        recording: where to.
        every: of a longer take, these are every n-th frame; for the numbers of frames.

    Raises:
        MissingExtraError: the extra ``viz`` is not installed.
    """
    rerun = require("rerun")
    colours = [query_colour(e) if entity.label in LABELS else MUTED for e, entity in enumerate(take.info.entities)]
    recording.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for v, view in enumerate(take.views):
        _log_camera(rerun, recording, take, view, v)
    _log_joint_curves(rerun, recording, take, every)
    for t in range(len(take)):
        _set_time(recording, take, t, every)
        _log_world(rerun, recording, take, t, colours)
        for v, view in enumerate(take.views):
            _log_view(rerun, recording, view, v, t, colours)


def take_blueprint(take: Take) -> rrb.Blueprint:
    """How the viewer arranges a take: the world on the left, cameras and joints on the right."""
    rrb = require("rerun.blueprint")
    images = []
    for v in range(len(take.views)):
        origin = f"/world/view_{v}/image"
        colour = rrb.Spatial2DView(
            origin=origin, contents=[f"{origin}/rgb", f"{origin}/links", f"{origin}/entities/**"], name=f"view {v}"
        )
        depth = rrb.Spatial2DView(origin=origin, contents=[f"{origin}/depth"], name=f"depth {v}")
        images.append(rrb.Tabs(colour, depth))
    joints = rrb.TimeSeriesView(origin="/joints", name="joint positions")
    hidden = [f"- /world/view_{v}/image/links" for v in range(len(take.views))]
    world = rrb.Spatial3DView(origin="/world", contents=["/world/**", *hidden], name="world")
    return rrb.Blueprint(
        rrb.Horizontal(world, rrb.Vertical(rrb.Grid(*images), joints, row_shares=[3, 1]), column_shares=[3, 2]),
        collapse_panels=True,
    )


def check_screen() -> None:
    """Raise ConfigError if there is no screen for Rerun's viewer."""
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ConfigError(
            "Rerun: there is no screen here (neither DISPLAY nor WAYLAND_DISPLAY is set); save a recording with --rrd "
            "FILE and open it elsewhere"
        )


def new_recording(application: str, name: str) -> rr.RecordingStream:
    """A recording that knows no other times than those that are logged.

    Raises:
        MissingExtraError: the extra ``viz`` is not installed.
    """
    recording = require("rerun").RecordingStream(application)
    recording.send_recording_name(name)
    recording.set_log_time_enabled(False)
    recording.set_log_tick_enabled(False)
    return recording


def _set_time(recording: rr.RecordingStream, take: Take, t: int, every: int) -> None:
    recording.set_time("frame", sequence=t * every)
    recording.set_time("time", duration=float(take.stamp_s[t]))


def _log_camera(rerun: ModuleType, recording: rr.RecordingStream, take: Take, view: View, v: int) -> None:
    """What does not change: intrinsics and the names and colours of links."""
    camera = view.clip.camera
    pinhole = rerun.Pinhole(
        image_from_camera=camera.matrix,
        resolution=[camera.width, camera.height],
        camera_xyz=rerun.ViewCoordinates.RDF,
        image_plane_distance=0.25 * take.info.half_diagonal_m,
    )
    recording.log(f"world/view_{v}/image", pinhole, static=True)
    classes = [rerun.AnnotationInfo(id=0, label="background", color=(0, 0, 0, 0))]
    for link in range(take.link_pose.shape[1]):
        carried = [e for e, entity in enumerate(take.info.entities) if entity.link == link]
        names = ", ".join(take.info.entities[e].name for e in carried)
        colour = query_colour(carried[0]) if carried else HELD
        label = f"link {link}" + (f" ({names})" if names else "")
        classes.append(rerun.AnnotationInfo(id=1 + link, label=label, color=colour))
    recording.log(f"world/view_{v}/image/links", rerun.AnnotationContext(classes), static=True)


def _log_joint_curves(rerun: ModuleType, recording: rr.RecordingStream, take: Take, every: int) -> None:
    times = [
        rerun.TimeColumn("frame", sequence=np.arange(len(take)) * every),
        rerun.TimeColumn("time", duration=take.stamp_s.astype(np.float64)),
    ]
    for j, joint in enumerate(take.info.joints):
        unit = "rad" if joint.kind == "revolute" else "m"
        colour = query_colour(j) if j in take.info.moved_joints else LINE
        path = rerun.new_entity_path(["joints", joint.name])
        recording.log(path, rerun.SeriesLines(names=f"{joint.name} ({unit})", colors=colour), static=True)
        values = take.joint_position[:, j].astype(np.float64)
        recording.send_columns(path, times, rerun.Scalars.columns(scalars=values))


def _log_world(rerun: ModuleType, recording: rr.RecordingStream, take: Take, t: int, colours: list[RGB]) -> None:
    size_m = take.info.half_diagonal_m
    begin = int(np.searchsorted(take.stamp_s, take.stamp_s[t] - TRAIL_S - 1e-6))
    for e, entity in enumerate(take.info.entities):
        point = rerun.Points3D(
            take.point_world[t, e][None], colors=colours[e], radii=0.02 * size_m, labels=entity.name, show_labels=False
        )
        recording.log(["world", "entities", entity.name], point)
        trail = rerun.LineStrips3D([take.point_world[begin : t + 1, e]], colors=colours[e], radii=0.006 * size_m)
        recording.log(["world", "trails", entity.name], trail)
    for j, joint in enumerate(take.info.joints):
        if t > 0 and np.array_equal(take.joint_axis[t, j], take.joint_axis[t - 1, j]):
            continue
        axis = take.joint_axis[t, j]
        arrow = rerun.Arrows3D(
            origins=axis[None, :3], vectors=0.4 * size_m * axis[None, 3:], colors=HELD, radii=0.008 * size_m,
            labels=f"{joint.name} ({joint.kind})", show_labels=False,
        )  # fmt: skip
        recording.log(["world", "joints", joint.name], arrow)


def _log_view(rerun: ModuleType, recording: rr.RecordingStream, view: View, v: int, t: int, colours: list[RGB]) -> None:
    clip, base = view.clip, f"world/view_{v}"
    if t == 0 or not np.array_equal(clip.cam_from_world[t], clip.cam_from_world[t - 1]):
        rotation, translation = clip.cam_from_world[t, :3, :3].T, clip.cam_from_world[t, :3, 3]
        pose = rerun.Transform3D(translation=-rotation @ translation, mat3x3=rotation)
        recording.log(base, pose)
    recording.log(f"{base}/image/rgb", rerun.Image(clip.rgb[t]).compress(jpeg_quality=_JPEG_QUALITY))
    if clip.depth_m is not None:
        depth = rerun.DepthImage(encode_depth(clip.depth_m[t]), meter=1 / DEPTH_SCALE_M)
        recording.log(f"{base}/image/depth", depth)
    recording.log(f"{base}/image/links", rerun.SegmentationImage(view.link_id[t], opacity=0.3))
    for name, shown in (("seen", view.visible[t]), ("hidden", ~view.visible[t] & np.isfinite(view.uv_px[t]).all(-1))):
        chosen = np.flatnonzero(shown)
        marks = rerun.Points2D(
            view.uv_px[t, chosen], colors=[colours[e] if name == "seen" else MUTED for e in chosen], radii=3.0
        )
        recording.log(f"{base}/image/entities/{name}", marks)
