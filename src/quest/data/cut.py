"""Some of the frames of a clip."""

from __future__ import annotations

from dataclasses import replace

from quest.types import Clip


def cut_clip(clip: Clip, frames: slice) -> Clip:
    """Some of the frames, as a clip of their own.

    Raises:
        InputError: there are none.
    """
    return replace(
        clip,
        rgb=clip.rgb[frames],
        depth_m=None if clip.depth_m is None else clip.depth_m[frames],
        stamp_s=clip.stamp_s[frames],
        cam_from_world=clip.cam_from_world[frames],
    )
