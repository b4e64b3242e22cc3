"""Overlays: a video that plays, marks where they belong, and odd tracks that must not break it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest

from quest.data.video import read_video
from quest.errors import InputError
from quest.types import Joints, State, Take, Tracks
from quest.viz.overlay import OverlayPainter, write_overlay
from quest.viz.palette import LOST, query_colour
from tests.synthetic import make_take


@pytest.fixture(scope="module")
def take() -> Take:
    return make_take(frames=10, views=1, size=(64, 48))


@pytest.fixture(scope="module")
def tracks(take: Take) -> Tracks:
    view = take.views[0]
    return Tracks(
        names=tuple(entity.name for entity in take.info.entities),
        labels=tuple(entity.label for entity in take.info.entities), uv_px=view.uv_px, point_world=take.point_world,
        confidence=np.full(view.visible.shape, 0.9, dtype=np.float32), visible=np.ones_like(view.visible),
        state=np.full(view.visible.shape, State.TRACKING.value, dtype="<U8"), stamp_s=take.stamp_s,
        frame_flags=("no poses",),
    )  # fmt: skip


def test_video_plays(take: Take, tracks: Tracks, tmp_path: Path):
    path = tmp_path / "new" / "overlay.mp4"
    write_overlay(take.views[0].clip, tracks, path)
    rgb, stamp_s = read_video(path)
    assert len(rgb) == 10
    assert rgb.shape[1] >= 720
    np.testing.assert_allclose(stamp_s, take.stamp_s, atol=1e-3)
    with av.open(str(path)) as container:
        assert container.streams.video[0].codec_context.name == "h264"
        assert container.streams.video[0].codec_context.pix_fmt == "yuv420p"
    assert [file.name for file in path.parent.iterdir()] == ["overlay.mp4"]


def test_marks_say_what_a_query_does(take: Take, tracks: Tracks):
    """Visible is filled with the query's colour, unseen hollow, lost red; held looks different."""
    clip = replace(take.views[0].clip, rgb=np.full_like(take.views[0].clip.rgb, 77))
    visible, state = tracks.visible.copy(), tracks.state.copy()
    visible[:, 1:], state[:, 2] = False, State.LOST.value
    frame = OverlayPainter(clip, replace(tracks, visible=visible, state=state)).frame(0)
    for k, colour in enumerate((query_colour(0), (77, 77, 77), LOST)):
        x, y = np.floor(tracks.uv_px[0, k] * 720 / 48).astype(int)
        np.testing.assert_allclose(frame[y, x].astype(int), colour, atol=2)
    held = OverlayPainter(clip, replace(tracks, state=np.full_like(state, State.HELD.value))).frame(0)
    assert (held != OverlayPainter(clip, tracks).frame(0)).any()


def test_frames_do_not_depend_on_the_future(take: Take, tracks: Tracks):
    later = tracks.uv_px.copy()
    later[6:] += 5
    a, b = OverlayPainter(take.views[0].clip, tracks), OverlayPainter(take.views[0].clip, replace(tracks, uv_px=later))
    np.testing.assert_array_equal(a.frame(5), b.frame(5))


@pytest.mark.parametrize("camera", ["still", "behind the joint"])
def test_joints_are_drawn_in_picture_inset_and_rows(take: Take, tracks: Tracks, camera: str):
    clip, frames = take.views[0].clip, len(tracks)
    if camera != "still":
        pose = clip.cam_from_world.copy()
        pose[:, 2, 3] -= 1.3
        clip = replace(clip, cam_from_world=pose)
    joint = take.info.entities[1].joint
    axis = take.joint_axis[0, joint].astype(np.float32)
    joints = replace(Joints.unknown(frames, 3), kind=("static", "revolute", "unknown"))
    joints.origin[1], joints.axis[1], joints.q[:, 1] = axis[:3], axis[3:], take.joint_position[:, joint]
    joints.q_min_seen[1], joints.q_max_seen[1] = 0, joints.q[:, 1].max()
    painter = OverlayPainter(clip, replace(tracks, joints=joints))
    plain, drawn = OverlayPainter(clip, tracks).frame(9), painter.frame(9)
    width, height = painter.size[0] - 360, 720
    changed = (plain != drawn).any(axis=-1)
    assert changed[:310, width:].any()
    if camera == "still":
        assert changed[:height, :width].any()
        middle = painter._pixels(axis[None, :3] + [0, 0, 0.55 * 0.5], 9)[0].astype(int)
        np.testing.assert_allclose(drawn[middle[1], middle[0]], query_colour(1), atol=40)


ODD: dict[str, Callable[[Tracks], Tracks]] = {
    "unbound": lambda tracks: replace(
        tracks, uv_px=tracks.uv_px * np.nan, point_world=tracks.point_world * np.nan, confidence=0 * tracks.confidence
    ),
    "no queries": lambda tracks: tracks.select([]),
    "many": lambda tracks: tracks.select(np.arange(40) % 3),
    "outside": lambda tracks: replace(tracks, uv_px=tracks.uv_px * np.float32(1e7)),
    "one point": lambda tracks: replace(tracks, point_world=np.zeros_like(tracks.point_world)),
    "odd names": lambda tracks: replace(tracks, names=("", "x" * 200, "ручка 把手\n"), frame_flags=("y" * 500,)),
}


@pytest.mark.parametrize("odd", ODD.values(), ids=ODD)
def test_odd_tracks_are_drawn(take: Take, tracks: Tracks, odd: Callable[[Tracks], Tracks]):
    painter = OverlayPainter(replace(take.views[0].clip, depth_m=None), odd(tracks))
    assert painter.frame(9).shape == (painter.size[1], painter.size[0], 3)


@pytest.mark.parametrize("size", [(333, 251), (60, 90)])
def test_any_size_becomes_even(tracks: Tracks, size: tuple[int, int]):
    take = make_take(frames=1, views=1, size=size)
    timed = ("uv_px", "point_world", "confidence", "visible", "state", "stamp_s")
    painter = OverlayPainter(take.views[0].clip, replace(tracks, **{name: getattr(tracks, name)[:1] for name in timed}))
    assert painter.size[0] % 2 == painter.size[1] % 2 == 0
    assert painter.size[1] >= 720
    assert painter.frame(0).shape == (painter.size[1], painter.size[0], 3)


def test_tracks_of_another_clip(take: Take, tracks: Tracks):
    longer = make_take(frames=11, views=1, size=(64, 48)).views[0].clip
    with pytest.raises(InputError, match="has 11 frames, its tracks 10"):
        OverlayPainter(longer, tracks)


def test_colours_are_distinct_and_never_red():
    colours = [query_colour(k) for k in range(32)]
    assert len(set(colours)) == 32
    assert all(np.abs(np.subtract(colour, LOST)).sum() > 90 for colour in colours)
