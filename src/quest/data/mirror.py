"""Mirror images of takes: left and right exchanged, in the pictures and in the world.

A mirrored world is as good a world as the other, so a take of a door that is hinged on the left becomes one of a door
that is hinged on the right: cheap variety where objects are few.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from quest.types import Camera, Take, View

_MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])


def mirrored_name(name: str) -> str:
    """What the mirror image of a take is called."""
    return f"{name}-mirrored"


def mirror_take(take: Take) -> Take:
    """The same event in a mirror: images flipped from left to right, the world's x axis turned around.

    Joints keep their positions: a hinge that turned by an angle about its axis turns by the same one about the
    mirrored axis, which points the other way.
    """
    flip = np.array([-1.0, 1.0, 1.0], dtype=np.float32)
    axis = take.joint_axis * np.tile(flip, 2)
    turning = [joint.kind == "revolute" for joint in take.info.joints]
    axis[:, turning, 3:] *= -1
    return replace(
        take,
        info=replace(take.info, name=mirrored_name(take.info.name)),
        views=tuple(_mirror_view(view) for view in take.views),
        point_world=take.point_world * flip,
        flow_world=take.flow_world * flip,
        link_pose=(_MIRROR @ take.link_pose @ _MIRROR).astype(take.link_pose.dtype),
        joint_axis=axis,
    )


def _mirror_view(view: View) -> View:
    clip = view.clip
    camera = Camera(
        clip.camera.fx,
        clip.camera.fy,
        clip.camera.width - clip.camera.cx,
        clip.camera.cy,
        clip.camera.width,
        clip.camera.height,
    )
    uv_px = view.uv_px.copy()
    uv_px[..., 0] = clip.camera.width - uv_px[..., 0]
    return View(
        clip=replace(
            clip,
            camera=camera,
            rgb=np.ascontiguousarray(clip.rgb[:, :, ::-1]),
            depth_m=None if clip.depth_m is None else np.ascontiguousarray(clip.depth_m[:, :, ::-1]),
            cam_from_world=_MIRROR @ clip.cam_from_world @ _MIRROR,
        ),
        uv_px=uv_px,
        visible=view.visible,
        link_id=np.ascontiguousarray(view.link_id[:, :, ::-1]),
        entity_id=np.ascontiguousarray(view.entity_id[:, :, ::-1]),
    )
