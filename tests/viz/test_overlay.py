"""Overlays: a video that plays, marks where they belong, and odd tracks that must not break it."""

from __future__ import annotations

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
        labels=tuple(entity.label for entity in take.info.entities),
        uv_px=view.uv_px,
        point_world=take.point_world,
        confidence=np.full(view.visible.shape, 0.9, dtype=np.float32),
        visible=np.ones_like(view.visible),
        state=np.full(view.visible.shape, State.TRACKING.value, dtype="<U8"),
        stamp_s=take.stamp_s,
        frame_flags=("no poses",),
    )


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


def pixel(painter: OverlayPainter, tracks: Tracks, t: int, k: int, height: int) -> np.ndarray:
    frame = painter.frame(t)
    x, y = np.floor(tracks.uv_px[t, k] * 720 / height).astype(int)
    return frame[y, x].astype(int)


def test_a_visible_mark_is_filled_with_the_colour_of_its_query(take: Take, tracks: Tracks):
    painter = OverlayPainter(take.views[0].clip, tracks)
    for k in range(3):
        np.testing.assert_allclose(pixel(painter, tracks, 0, k, 48), query_colour(k), atol=2)


def test_an_unseen_mark_is_hollow_and_a_lost_one_red(take: Take, tracks: Tracks):
    clip = replace(take.views[0].clip, rgb=np.full_like(take.views[0].clip.rgb, 77))
    state = tracks.state.copy()
    state[:, 1] = State.LOST.value
    painter = OverlayPainter(clip, replace(tracks, visible=np.zeros_like(tracks.visible), state=state))
    np.testing.assert_allclose(pixel(painter, tracks, 0, 0, 48), 77, atol=2)
    np.testing.assert_allclose(pixel(painter, tracks, 0, 1, 48), LOST, atol=2)


def test_states_look_different(take: Take, tracks: Tracks):
    pictures = []
    for state in State:
        of_one_kind = replace(tracks, state=np.full_like(tracks.state, state.value))
        pictures.append(OverlayPainter(take.views[0].clip, of_one_kind).frame(9))
    assert (pictures[0] != pictures[1]).any()
    assert (pictures[1] != pictures[2]).any()


def test_frames_do_not_depend_on_the_future(take: Take, tracks: Tracks):
    later = tracks.uv_px.copy()
    later[6:] += 5
    a, b = OverlayPainter(take.views[0].clip, tracks), OverlayPainter(take.views[0].clip, replace(tracks, uv_px=later))
    for t in range(6):
        np.testing.assert_array_equal(a.frame(t), b.frame(t))


@pytest.mark.parametrize("camera", ["still", "behind the joint"])
def test_joints_are_drawn_in_picture_inset_and_rows(take: Take, tracks: Tracks, camera: str):
    clip, frames = take.views[0].clip, len(tracks)
    if camera != "still":
        pose = clip.cam_from_world.copy()
        pose[:, 2, 3] -= 1.3
        clip = replace(clip, cam_from_world=pose)
    joint = take.info.entities[1].joint
    axis = take.joint_axis[0, joint].astype(np.float32)
    unknown = Joints.unknown(frames, 3)
    axes, origin, q = unknown.axis.copy(), unknown.origin.copy(), unknown.q.copy()
    origin[1], axes[1] = axis[:3], axis[3:]
    q[:, 1] = take.joint_position[:, joint]
    seen = np.array([np.nan, q[:, 1].max(), np.nan], np.float32)
    joints = replace(
        unknown, kind=("static", "revolute", "unknown"), axis=axes, origin=origin, q=q, q_min_seen=0 * seen,
        q_max_seen=seen,
    )  # fmt: skip
    painter = OverlayPainter(clip, replace(tracks, joints=joints))
    plain, drawn = OverlayPainter(clip, tracks).frame(9), painter.frame(9)
    width, height = painter.size[0] - 360, 720
    changed = (plain != drawn).any(axis=-1)
    assert changed[:310, width:].any()
    if camera == "still":
        assert changed[:height, :width].any()
        middle = painter._pixels(axis[None, :3] + [0, 0, 0.55 * 0.5], 9)[0].astype(int)
        np.testing.assert_allclose(drawn[middle[1], middle[0]], query_colour(1), atol=40)


@pytest.mark.parametrize("what", ["unbound", "no queries", "many", "outside", "one point", "odd names", "no depth"])
def test_odd_tracks_are_drawn(take: Take, tracks: Tracks, what: str):
    clip = take.views[0].clip
    if what == "unbound":
        nan = np.full_like(tracks.uv_px, np.nan)
        tracks = replace(
            tracks, uv_px=nan, point_world=np.full_like(tracks.point_world, np.nan), confidence=0 * tracks.confidence
        )
    elif what == "no queries":
        tracks = tracks.select([])
    elif what == "many":
        tracks = tracks.select(np.arange(40) % 3)
    elif what == "outside":
        tracks = replace(tracks, uv_px=tracks.uv_px * np.float32(1e7))
    elif what == "one point":
        tracks = replace(tracks, point_world=np.zeros_like(tracks.point_world))
    elif what == "odd names":
        tracks = replace(tracks, names=("", "x" * 200, "ручка 把手\n"), frame_flags=("y" * 500,))
    else:
        clip = replace(clip, depth_m=None)
    painter = OverlayPainter(clip, tracks)
    assert painter.frame(9).shape == (painter.size[1], painter.size[0], 3)


@pytest.mark.slow
@pytest.mark.parametrize("size", [(333, 251), (60, 90), (1300, 902)])
def test_any_size_becomes_even(tracks: Tracks, size: tuple[int, int]):
    take = make_take(frames=1, views=1, size=size)
    cut = {
        name: getattr(tracks, name)[:1]
        for name in ("uv_px", "point_world", "confidence", "visible", "state", "stamp_s")
    }
    painter = OverlayPainter(take.views[0].clip, replace(tracks, **cut))
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
