"""Takes and tracks in Rerun. Timelines are ``frame`` and ``time``.

Below ``world`` are ``entities``, ``trails`` (of the last second) and ``joints``. A take has one ``view_N`` per camera,
whose ``image`` holds ``rgb``, ``depth``, ``links`` and ``entities``, and below ``joints`` one curve per joint. Tracks
have one ``camera`` with such an image, joints as they are known at the end (the axis of turning with the arc that was
seen, or the line of sliding), what the camera sees as coloured ``points``, and curves of the entities: ``confidence``,
and below ``joints`` the coordinate in degrees or metres where it moves. Without depth nothing of tracks is in space.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float

from quest.data.take_format import DEPTH_SCALE_M, encode_depth
from quest.errors import ConfigError
from quest.extras import require
from quest.geometry import invert, lift, transform
from quest.types import Camera, Clip, Take, Tracks, View
from quest.viz.joint_lines import joint_lines
from quest.viz.palette import HELD, LINE, MUTED, RGB, entity_colours, query_colour
from quest.whole_file import whole_file

if TYPE_CHECKING:
    import rerun.blueprint as rrb

TRAIL_S = 1.0
_JPEG_QUALITY = 90
_CAMERA = "world/camera"
_CLOUD_POINTS = 8000
"""Of a frame, in space."""


def save_rrd(take: Take, path: str | Path | None, *, every: int = 1) -> None:
    """Write a take as a Rerun recording, all or nothing.

    Args:
        take: the take.
        path: file to write, ``.rrd`` by custom; its folder is made. None opens Rerun's viewer, or the one that is open.
        every: of a longer take, these are every n-th frame; for the numbers of frames.

    Raises:
        ConfigError: there is no screen for the viewer.
        MissingExtraError: the extra ``viz`` is not installed.
    """
    check_viewer(on_screen=path is None)
    log = _Log("quest-take", take.info.name, take.stamp_s, size_m=take.info.half_diagonal_m, every=every)
    log.record(_take_blueprint(take), lambda: _log_take(log, take), path)


def save_tracks(clip: Clip, tracks: Tracks, path: str | Path | None) -> None:
    """Write the tracks of a clip as a Rerun recording, all or nothing.

    Args:
        clip: the frames that were tracked.
        tracks: the answers, one per frame of the clip.
        path: as for :func:`save_rrd`, and so are the errors.
    """
    check_viewer(on_screen=path is None)
    points = tracks.point_world[np.isfinite(tracks.point_world).all(axis=-1)]
    size_m = max(float(np.linalg.norm(np.ptp(points, axis=0))) if len(points) > 1 else 0.0, 0.2)
    log = _Log("quest-tracks", clip.name, clip.stamp_s, size_m=size_m)
    log.record(_tracks_blueprint(clip), lambda: _log_tracks(log, clip, tracks), path)


def check_viewer(*, on_screen: bool) -> None:
    """See before the work whether its result can be shown, on the screen or in a file.

    Raises:
        MissingExtraError: the extra ``viz`` is not installed.
        ConfigError: there is no screen.
    """
    require("rerun")
    if on_screen and sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ConfigError(
            "Rerun: there is no screen here (neither DISPLAY nor WAYLAND_DISPLAY is set); save a recording with --rrd "
            "FILE and open it elsewhere"
        )


class _Log:
    """A recording that knows no other times than those of its frames, and what takes and tracks have in common.

    ``size_m`` is that of what is seen, for the sizes of marks; frames are every n-th of a longer take.
    """

    def __init__(
        self, application: str, name: str, stamp_s: Float[np.ndarray, " T"], *, size_m: float, every: int = 1
    ) -> None:
        self.rerun = require("rerun")
        self.stream: Any = self.rerun.RecordingStream(application)
        self.stream.send_recording_name(name)
        self.stream.set_log_time_enabled(False)
        self.stream.set_log_tick_enabled(False)
        self.size_m, self.stamp_s = size_m, stamp_s.astype(np.float64)
        self.frames = np.arange(len(stamp_s)) * every

    def record(self, blueprint: rrb.Blueprint, fill: Callable[[], None], path: str | Path | None) -> None:
        """Fill it into a file, whole or not at all, or into the viewer."""
        if path is None:
            self.stream.spawn(default_blueprint=blueprint)
            fill()
            self.stream.flush()
            return
        with whole_file(Path(path)) as partial:
            self.stream.save(partial, default_blueprint=blueprint)
            fill()
            self.stream.flush()
            self.stream.disconnect()

    def at(self, t: int) -> None:
        """What is logged next is of frame ``t``."""
        self.stream.set_time("frame", sequence=int(self.frames[t]))
        self.stream.set_time("time", duration=float(self.stamp_s[t]))

    def camera(self, path: str, camera: Camera) -> None:
        """Intrinsics."""
        pinhole = self.rerun.Pinhole(
            image_from_camera=camera.matrix,
            resolution=[camera.width, camera.height],
            camera_xyz=self.rerun.ViewCoordinates.RDF,
            image_plane_distance=0.25 * self.size_m,
        )
        self.stream.log(f"{path}/image", pinhole, static=True)

    def frame(self, path: str, clip: Clip, t: int) -> None:
        """Pose where it changes, colours and depth."""
        pose = clip.cam_from_world[t]
        if t == 0 or not np.array_equal(pose, clip.cam_from_world[t - 1]):
            rotation = pose[:3, :3].T
            moved = self.rerun.Transform3D(translation=-rotation @ pose[:3, 3], mat3x3=rotation)
            self.stream.log(path, moved)
        self.stream.log(f"{path}/image/rgb", self.rerun.Image(clip.rgb[t]).compress(jpeg_quality=_JPEG_QUALITY))
        if clip.depth_m is not None:
            depth = self.rerun.DepthImage(encode_depth(clip.depth_m[t]), meter=1 / DEPTH_SCALE_M)
            self.stream.log(f"{path}/image/depth", depth)

    def cloud(self, path: str, clip: Clip, t: int) -> None:
        """What is seen in a frame as coloured points, of every so many pixels."""
        assert clip.depth_m is not None
        height, width = clip.depth_m.shape[1:]
        step = max(1, round((height * width / _CLOUD_POINTS) ** 0.5))
        v, u = (grid.ravel() for grid in np.mgrid[step // 2 : height : step, step // 2 : width : step])
        z = clip.depth_m[t, v, u]
        known = np.isfinite(z) & (z > 0)
        v, u, z = v[known], u[known], torch.from_numpy(z[known].astype(np.float64))
        pixel = torch.from_numpy(np.stack((u, v), axis=-1) + 0.5)
        world_from_cam = invert(torch.from_numpy(clip.cam_from_world[t].astype(np.float64)))
        points = transform(world_from_cam[None], lift(pixel, z, clip.camera))
        radii = (0.5 * step / clip.camera.fx * z).numpy()
        self.stream.log(path, self.rerun.Points3D(points.numpy(), colors=clip.rgb[t, v, u], radii=radii))

    def point(self, name: str, points: Float[np.ndarray, "T 3"], t: int, colour: RGB, trail_colour: RGB) -> None:
        """Where an entity is, and its trail."""
        begin = int(np.searchsorted(self.stamp_s, self.stamp_s[t] - TRAIL_S - 1e-6))
        trail = points[begin : t + 1]
        trail = trail[np.isfinite(trail).all(axis=-1)]
        if len(trail):
            look = {"colors": colour, "radii": 0.02 * self.size_m, "labels": name, "show_labels": False}
            self.stream.log(["world", "entities", name], self.rerun.Points3D(trail[-1:], **look))
            line = self.rerun.LineStrips3D([trail], colors=trail_colour, radii=0.006 * self.size_m)
            self.stream.log(["world", "trails", name], line)

    def arrow(self, path: list[str], line: Float[np.ndarray, "2 3"], label: str, colour: RGB, **more: Any) -> None:
        """An axis."""
        arrow = self.rerun.Arrows3D(
            origins=line[:1], vectors=line[1:] - line[:1], colors=colour, radii=0.008 * self.size_m, labels=label,
            show_labels=False,
        )  # fmt: skip
        self.stream.log(path, arrow, **more)

    def curve(
        self, path: list[str], label: str, colour: RGB, values: Float[np.ndarray, " T"], shown: Any = ...
    ) -> None:
        """Values over the frames, or over those that are shown."""
        rr, entity = self.rerun, self.rerun.new_entity_path(path)
        self.stream.log(entity, rr.SeriesLines(names=label, colors=colour), static=True)
        frames = rr.TimeColumn("frame", sequence=self.frames[shown])
        times = rr.TimeColumn("time", duration=self.stamp_s[shown])
        self.stream.send_columns(entity, [frames, times], rr.Scalars.columns(scalars=values[shown].astype(np.float64)))


def _take_blueprint(take: Take) -> rrb.Blueprint:
    """The world on the left, cameras and joints on the right."""
    rrb, images = require("rerun.blueprint"), []
    for v in range(len(take.views)):
        origin = f"/world/view_{v}/image"
        contents = [f"{origin}/rgb", f"{origin}/links", f"{origin}/entities/**"]
        colour = rrb.Spatial2DView(origin=origin, contents=contents, name=f"view {v}")
        depth = rrb.Spatial2DView(origin=origin, contents=[f"{origin}/depth"], name=f"depth {v}")
        images.append(rrb.Tabs(colour, depth))
    joints = rrb.TimeSeriesView(origin="/joints", name="joint positions")
    hidden = [f"- /world/view_{v}/image/links" for v in range(len(take.views))]
    world = rrb.Spatial3DView(origin="/world", contents=["/world/**", *hidden], name="world")
    side = rrb.Vertical(rrb.Grid(*images), joints, row_shares=[3, 1])
    return rrb.Blueprint(rrb.Horizontal(world, side, column_shares=[3, 2]), collapse_panels=True)


def _tracks_blueprint(clip: Clip) -> rrb.Blueprint:
    """The picture above the curves of confidence; beside them the world, where there is depth."""
    rrb, image = require("rerun.blueprint"), f"/{_CAMERA}/image"
    picture = rrb.Spatial2DView(origin=image, contents=[f"{image}/rgb", f"{image}/entities/**"], name=clip.name)
    curves = rrb.TimeSeriesView(origin="/confidence", name="confidence")
    if clip.depth_m is None:
        return rrb.Blueprint(rrb.Vertical(picture, curves, row_shares=[3, 1]), collapse_panels=True)
    coordinates = rrb.TimeSeriesView(origin="/joints", name="coordinates on joints")
    flat = rrb.Vertical(picture, rrb.Horizontal(curves, coordinates), row_shares=[3, 1])
    seen = ["/world/**", f"- {image}/depth"]
    world = rrb.Spatial3DView(origin="/world", contents=seen, name="world", eye_controls=_eye(clip))
    return rrb.Blueprint(rrb.Horizontal(world, flat), collapse_panels=True)


def _eye(clip: Clip) -> Any:
    """Where a viewer begins: behind the first camera, to the right of it and above, looking where it looks."""
    assert clip.depth_m is not None
    pose = clip.cam_from_world[0].astype(np.float64)
    known = clip.depth_m[0][clip.depth_m[0] > 0]
    far = float(np.median(known)) if len(known) else 1.0
    right, down, ahead = pose[:3, :3]
    position = -pose[:3, :3].T @ pose[:3, 3]
    eye = position + far * (0.35 * right - 0.3 * down - 0.25 * ahead)
    target = position + far * ahead
    return require("rerun.blueprint").EyeControls3D(position=eye, look_target=target, eye_up=-down)


def _log_take(log: _Log, take: Take) -> None:
    info = take.info
    colours = entity_colours(entity.label for entity in info.entities)
    log.stream.log("world", log.rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for v, view in enumerate(take.views):
        log.camera(f"world/view_{v}", view.clip.camera)
        log.stream.log(f"world/view_{v}/image/links", _link_names(log, take), static=True)
    for j, joint in enumerate(info.joints):
        unit = "rad" if joint.kind == "revolute" else "m"
        colour = query_colour(j) if j in info.moved_joints else LINE
        log.curve(["joints", joint.name], f"{joint.name} ({unit})", colour, take.joint_position[:, j])
    for t in range(len(take)):
        log.at(t)
        for e, entity in enumerate(info.entities):
            log.point(entity.name, take.point_world[:, e], t, colours[e], colours[e])
        for j, joint in enumerate(info.joints):
            axis = take.joint_axis[t, j]
            if t == 0 or not np.array_equal(axis, take.joint_axis[t - 1, j]):
                line = np.stack((axis[:3], axis[:3] + 0.4 * log.size_m * axis[3:]))
                log.arrow(["world", "joints", joint.name], line, f"{joint.name} ({joint.kind})", HELD)
        for v, view in enumerate(take.views):
            log.frame(f"world/view_{v}", view.clip, t)
            _log_truth(log, f"world/view_{v}/image", view, t, colours)


def _link_names(log: _Log, take: Take) -> Any:
    """Names and colours of links, by the entities that they carry."""
    classes = [log.rerun.AnnotationInfo(id=0, label="background", color=(0, 0, 0, 0))]
    for link in range(take.link_pose.shape[1]):
        carried = [e for e, entity in enumerate(take.info.entities) if entity.link == link]
        names = ", ".join(take.info.entities[e].name for e in carried)
        colour = query_colour(carried[0]) if carried else HELD
        label = f"link {link}" + (f" ({names})" if names else "")
        classes.append(log.rerun.AnnotationInfo(id=1 + link, label=label, color=colour))
    return log.rerun.AnnotationContext(classes)


def _log_truth(log: _Log, image: str, view: View, t: int, colours: list[RGB]) -> None:
    """Links, and entities that are seen and that are not."""
    log.stream.log(f"{image}/links", log.rerun.SegmentationImage(view.link_id[t], opacity=0.3))
    for name, shown in (("seen", view.visible[t]), ("hidden", ~view.visible[t] & np.isfinite(view.uv_px[t]).all(-1))):
        chosen = np.flatnonzero(shown)
        colour = [colours[e] if name == "seen" else MUTED for e in chosen]
        log.stream.log(f"{image}/entities/{name}", log.rerun.Points2D(view.uv_px[t, chosen], colors=colour, radii=3.0))


def _log_tracks(log: _Log, clip: Clip, tracks: Tracks) -> None:
    log.stream.log("world", log.rerun.ViewCoordinates.RDF, static=True)
    log.camera(_CAMERA, clip.camera)
    bound = np.asarray(np.isfinite(tracks.uv_px).all(axis=-1))
    for k, name in enumerate(tracks.names):
        log.curve(["confidence", name], name, query_colour(k), tracks.confidence[:, k], bound[:, k])
    for t in range(len(clip)):
        log.at(t)
        log.frame(_CAMERA, clip, t)
        if clip.depth_m is not None:
            log.cloud("world/points", clip, t)
        for k in np.flatnonzero(bound[t]).tolist():
            name, colour = tracks.names[k], query_colour(k) if tracks.visible[t, k] else MUTED
            label = f"{name} ({tracks.state[t, k]})"
            mark = log.rerun.Points2D(tracks.uv_px[t, k][None], colors=colour, radii=4.0, labels=label)
            log.stream.log([*_CAMERA.split("/"), "image", "entities", name], mark)
            log.point(name, tracks.point_world[:, k], t, colour, query_colour(k))
    joints = tracks.joints
    for k, (name, lines) in enumerate(zip(tracks.names, joint_lines(tracks), strict=True)):
        if joints is None or lines is None:
            continue
        colour, label = query_colour(k), f"{name}: {joints.describe(k)}"
        path = log.rerun.LineStrips3D(
            [lines.path, *lines.arms], colors=colour, show_labels=False, labels=[label, *("" for _ in lines.arms)],
            radii=[0.008 * log.size_m, *(0.002 * log.size_m for _ in lines.arms)],
        )  # fmt: skip
        log.stream.log(["world", "joints", name, "path"], path, static=True)
        if lines.axis is not None:
            log.arrow(["world", "joints", name, "axis"], lines.axis, label, colour, static=True)
        factor, unit = (180 / np.pi, "deg") if joints.kind[k] == "revolute" else (1.0, "m")
        log.curve(["joints", name], f"{name} ({unit})", colour, factor * joints.q[:, k].astype(np.float64))
