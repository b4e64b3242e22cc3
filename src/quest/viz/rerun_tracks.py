"""Tracks of a recording in Rerun: frames, depth as points, entities and their trails, joints.

Below ``world`` are ``entities``, ``trails`` (of the last second), ``joints`` (as they are known at the end: the axis of
turning with the arc that was seen, or the line of sliding) and ``camera``, whose ``image`` holds ``rgb``, ``depth`` and
the ``entities`` in the picture. ``confidence`` has one curve per entity, ``joints`` its coordinate in degrees or metres
where it moves. Without depth there is nothing in space. Timelines are ``frame`` and ``time``.
"""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np

from quest.data.take_format import DEPTH_SCALE_M, encode_depth
from quest.extras import require
from quest.types import Clip, Tracks
from quest.viz.joint_lines import joint_lines
from quest.viz.palette import MUTED, query_colour
from quest.viz.rerun_log import TRAIL_S, check_screen, new_recording
from quest.whole_file import whole_file

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

APPLICATION = "quest-tracks"
_JPEG_QUALITY = 90
_IMAGE = "world/camera/image"


def check_viewer(*, on_screen: bool) -> None:
    """See before the work whether its result can be shown.

    Args:
        on_screen: whether the viewer is to open.

    Raises:
        MissingExtraError: the extra ``viz`` is not installed.
        ConfigError: there is no screen.
    """
    require("rerun")
    if on_screen:
        check_screen()


def save_tracks(clip: Clip, tracks: Tracks, path: str | Path) -> None:
    """Write the tracks of a clip as a Rerun recording, all or nothing.

    Args:
        clip: the frames that were tracked.
        tracks: the answers, one per frame of the clip.
        path: file to write, ``.rrd`` by custom; its folder is made.

    Raises:
        MissingExtraError: the extra ``viz`` is not installed.
    """
    recording = new_recording(APPLICATION, clip.name)
    with whole_file(Path(path)) as partial:
        recording.save(partial, default_blueprint=_blueprint(clip))
        log_tracks(clip, tracks, recording)
        recording.flush()
        recording.disconnect()


def open_tracks(clip: Clip, tracks: Tracks) -> None:
    """Open Rerun's viewer, or the one that is open, on the tracks of a clip.

    Args:
        clip: the frames that were tracked.
        tracks: the answers, one per frame of the clip.

    Raises:
        ConfigError: there is no screen.
        MissingExtraError: the extra ``viz`` is not installed.
    """
    check_viewer(on_screen=True)
    recording = new_recording(APPLICATION, clip.name)
    recording.spawn(default_blueprint=_blueprint(clip))
    log_tracks(clip, tracks, recording)
    recording.flush()


def log_tracks(clip: Clip, tracks: Tracks, recording: rr.RecordingStream) -> None:
    """Log the frames of a clip and the answers of its tracks.

    Args:
        clip: the frames that were tracked.
        tracks: the answers, one per frame of the clip.
        recording: where to.

    Raises:
        MissingExtraError: the extra ``viz`` is not installed.
    """
    rerun = require("rerun")
    points = tracks.point_world[np.isfinite(tracks.point_world).all(axis=-1)]
    size_m = float(np.linalg.norm(np.ptp(points, axis=0))) if len(points) > 1 else 0.0
    size_m = max(size_m, 0.2)
    camera = clip.camera
    pinhole = rerun.Pinhole(
        image_from_camera=camera.matrix,
        resolution=[camera.width, camera.height],
        camera_xyz=rerun.ViewCoordinates.RDF,
        image_plane_distance=0.25 * size_m,
    )
    recording.log("world", rerun.ViewCoordinates.RDF, static=True)
    recording.log(_IMAGE, pinhole, static=True)
    for k, name in enumerate(tracks.names):
        path = rerun.new_entity_path(["confidence", name])
        recording.log(path, rerun.SeriesLines(names=name, colors=query_colour(k)), static=True)
    for t in range(len(clip)):
        recording.set_time("frame", sequence=t)
        recording.set_time("time", duration=float(clip.stamp_s[t]))
        _log_frame(rerun, recording, clip, t)
        _log_answers(rerun, recording, tracks, t, size_m)
    _log_joints(rerun, recording, tracks, size_m)


def _blueprint(clip: Clip) -> rrb.Blueprint:
    """The picture above the curves of confidence; beside them the world, where there is depth."""
    rrb = require("rerun.blueprint")
    picture = rrb.Spatial2DView(
        origin=f"/{_IMAGE}", contents=[f"/{_IMAGE}/rgb", f"/{_IMAGE}/entities/**"], name=clip.name
    )
    curves = rrb.TimeSeriesView(origin="/confidence", name="confidence")
    if clip.depth_m is None:
        return rrb.Blueprint(rrb.Vertical(picture, curves, row_shares=[3, 1]), collapse_panels=True)
    coordinates = rrb.TimeSeriesView(origin="/joints", name="coordinates on joints")
    flat = rrb.Vertical(picture, rrb.Horizontal(curves, coordinates), row_shares=[3, 1])
    world = rrb.Spatial3DView(origin="/world", name="world")
    return rrb.Blueprint(rrb.Horizontal(world, flat), collapse_panels=True)


def _log_frame(rerun: ModuleType, recording: rr.RecordingStream, clip: Clip, t: int) -> None:
    if t == 0 or not np.array_equal(clip.cam_from_world[t], clip.cam_from_world[t - 1]):
        rotation, translation = clip.cam_from_world[t, :3, :3].T, clip.cam_from_world[t, :3, 3]
        recording.log("world/camera", rerun.Transform3D(translation=-rotation @ translation, mat3x3=rotation))
    recording.log(f"{_IMAGE}/rgb", rerun.Image(clip.rgb[t]).compress(jpeg_quality=_JPEG_QUALITY))
    if clip.depth_m is not None:
        recording.log(f"{_IMAGE}/depth", rerun.DepthImage(encode_depth(clip.depth_m[t]), meter=1 / DEPTH_SCALE_M))


def _log_answers(rerun: ModuleType, recording: rr.RecordingStream, tracks: Tracks, t: int, size_m: float) -> None:
    begin = int(np.searchsorted(tracks.stamp_s, tracks.stamp_s[t] - TRAIL_S - 1e-6))
    for k, name in enumerate(tracks.names):
        if not np.isfinite(tracks.uv_px[t, k]).all():
            continue
        label = f"{name} ({tracks.state[t, k]})"
        colour = query_colour(k) if tracks.visible[t, k] else MUTED
        mark = rerun.Points2D(tracks.uv_px[t, k][None], colors=colour, radii=4.0, labels=label)
        recording.log([*_IMAGE.split("/"), "entities", name], mark)
        recording.log(["confidence", name], rerun.Scalars(float(tracks.confidence[t, k])))
        trail = tracks.point_world[begin : t + 1, k]
        trail = trail[np.isfinite(trail).all(axis=-1)]
        if len(trail):
            point = rerun.Points3D(trail[-1:], colors=colour, radii=0.02 * size_m, labels=name, show_labels=False)
            recording.log(["world", "entities", name], point)
            line = rerun.LineStrips3D([trail], colors=query_colour(k), radii=0.006 * size_m)
            recording.log(["world", "trails", name], line)


def _log_joints(rerun: ModuleType, recording: rr.RecordingStream, tracks: Tracks, size_m: float) -> None:
    """Axes and paths of the joints that move, and the coordinate in every frame."""
    joints = tracks.joints
    if joints is None:
        return
    times = [
        rerun.TimeColumn("frame", sequence=np.arange(len(tracks))),
        rerun.TimeColumn("time", duration=tracks.stamp_s.astype(np.float64)),
    ]
    for k, (name, lines) in enumerate(zip(tracks.names, joint_lines(tracks), strict=True)):
        if lines is None:
            continue
        colour, label = query_colour(k), f"{name}: {joints.describe(k)}"
        path = rerun.LineStrips3D(
            [lines.path, *lines.arms], colors=colour, radii=[0.008 * size_m, *(0.002 * size_m for _ in lines.arms)],
            labels=[label, *("" for _ in lines.arms)], show_labels=False,
        )  # fmt: skip
        recording.log(["world", "joints", name, "path"], path, static=True)
        if lines.axis is not None:
            arrow = rerun.Arrows3D(
                origins=lines.axis[:1], vectors=lines.axis[1:] - lines.axis[:1], colors=colour, radii=0.008 * size_m,
                labels=label, show_labels=False,
            )  # fmt: skip
            recording.log(["world", "joints", name, "axis"], arrow, static=True)
        factor, unit = (180 / np.pi, "deg") if joints.kind[k] == "revolute" else (1.0, "m")
        curve = rerun.new_entity_path(["joints", name])
        recording.log(curve, rerun.SeriesLines(names=f"{name} ({unit})", colors=colour), static=True)
        values = factor * joints.q[:, k].astype(np.float64)
        recording.send_columns(curve, times, rerun.Scalars.columns(scalars=values))
