"""A stream that is corrected while it runs: edits come between frames, and what is refused changes nothing."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from quest.data.frame_source import FrameSource, source_of_clip
from quest.errors import InputError
from quest.filter.joints import Joint, JointKind
from quest.live.session import Edit, Session, Shot, drawn_joints
from quest.types import Clip, Query
from tests.track.clips import make_clip, make_tracker

POINTS = [Query.point(0, 20, 30, name="a"), Query.point(0, 40.5, 22.25, name="b")]


@pytest.fixture(scope="module")
def clip() -> Clip:
    return make_clip(frames=6)


class Watched:
    """A session whose edits are asked for right before some frames, and all that it showed."""

    def __init__(self, clip: Clip, edits: dict[int, list[Edit]], **options: Any) -> None:
        self.said: list[str] = []
        self.shots: list[Shot] = []
        source = source_of_clip(clip)

        def frames() -> Iterator[Any]:
            for t, frame in enumerate(clip.frame(t) for t in range(len(clip))):
                asked.extend(self.session.ask(edit) for edit in edits.get(t, []))
                yield frame

        asked: list[Any] = []
        self.session = Session(make_tracker(), replace(source, frames=frames), POINTS, wait=True, **options)
        self.session.on_shot(self.shots.append)
        self.events = [event for events in self.session.run() for event in events]
        self.headers = [json.loads(shot.header) for shot in self.shots]
        self.errors = [future.exception() for future in asked]

    def names(self, t: int) -> list[str]:
        return [query["name"] for query in self.headers[t]["state"]["queries"]]


def test_edits_come_between_frames(clip: Clip):
    edits = {
        2: [Edit("point", frame=1, x=10, y=12, name="c"), Edit("retire", query=0)],
        4: [Edit("rename", query=1, name="second"), Edit("place", query=2, frame=3, x=50, y=50)],
        5: [Edit("confirm", query=1), Edit("label", label="handle"), Edit("text", words="the left handle")],
    }
    watched = Watched(clip, edits)
    assert watched.errors == [None] * 7
    assert [watched.names(t) for t in (0, 2, 4)] == [["a", "b"], ["b", "c"], ["second", "c"]]
    at = np.array(watched.headers[4]["state"]["queries"][1]["uv_px"])
    assert np.linalg.norm(at - 50) < 5
    assert len(watched.headers) == len(clip)
    assert next(event.text for event in watched.events if event.kind == "bound") == "now following a, b"


def test_what_is_refused_changes_nothing(clip: Clip):
    wrong = [
        Edit("retire", query=9), Edit("rename", query=0, name="b"), Edit("point", frame=50, x=1, y=1),
        Edit("point", frame=1, x=64.5, y=1), Edit("point", frame=1, x=float("nan"), y=1), Edit("label", label="wheel"),
        Edit("label"), Edit("text", words="all handles"), Edit("confirm", query=9), Edit("place", query=9, frame=1),
    ]  # fmt: skip
    watched, plain = Watched(clip, {2: wrong}), Watched(clip, {})
    assert all(isinstance(error, InputError) for error in watched.errors)
    assert [header["state"] for header in watched.headers] == [header["state"] for header in plain.headers]


@pytest.mark.parametrize("remembered_s", [300.0, 0.0])
def test_a_pixel_of_an_older_picture_is_carried_to_now(remembered_s: float, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("quest.live.session._REMEMBERED_S", remembered_s)
    square = np.zeros((120, 160, 3), np.uint8)
    square[:] = cv2.resize(np.random.default_rng(0).integers(0, 255, (15, 20, 3), np.uint8), (160, 120))
    rgb = np.stack([np.roll(square, 2 * t, axis=1) for t in range(24)])
    clip = Clip.from_arrays(rgb, fov_deg=60)
    session = Session(make_tracker(), source_of_clip(clip), [], wait=True)
    asked = []
    for t, _ in enumerate(session.run()):
        if t == 20:
            asked.append(session.ask(Edit("point", frame=1, x=20, y=60, name="old")))
    if not remembered_s:
        with pytest.raises(InputError, match="frame 1 is over"):
            asked[0].result()
        return
    assert asked[0].result() == "followed"
    assert session.state is not None
    np.testing.assert_allclose(session.state.uv_px[0], (20 + 44, 60), atol=1.5)


def test_what_is_kept(clip: Clip, tmp_path: Path):
    edit = Edit("place", query=0, frame=2, x=30, y=30)
    Watched(clip, {3: [edit, Edit("retire", query=7)]}, record=tmp_path)
    lines = [json.loads(line) for line in (tmp_path / "frames.jsonl").read_text().splitlines()]
    assert [line["frame"] for line in lines] == list(range(6))
    kept = [json.loads(line) for line in (tmp_path / "edits.jsonl").read_text().splitlines()]
    assert kept == [{"next_frame": 3, "edit": asdict(edit)}]


def test_a_paused_session_follows_nothing_until_it_goes_on(clip: Clip):
    source: FrameSource = source_of_clip(clip)
    session = Session(make_tracker(), source, POINTS, wait=True)
    session.ask(Edit("pause"))
    going_on = iter(session.run())
    session.ask(Edit("resume"))
    next(going_on)
    assert session.stream.frame == 1
    session.stop()
    assert list(going_on) == []


def test_joints_are_drawn_where_their_points_are(clip: Clip):
    """A lid that turns about the vertical, seen from the front: the path goes through the point's pixel."""
    watched = Watched(clip, {})
    state, camera = watched.session.state, clip.camera
    assert state is not None
    assert all(header["joints"] == [None, None] for header in watched.headers[:1])
    point = np.array([[0.1, 0.0, 1.0], [0.0, 0.0, 1.0]], np.float32)
    turns = Joint(
        JointKind.REVOLUTE, np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]), point[0].astype(float), 0.0, 1.0,
        np.eye(4),
    )  # fmt: skip
    known = replace(
        state, point_world=point, joint=(turns, None), q=np.array([0.0, np.nan], np.float32), cam_from_world=np.eye(4)
    )
    turned, nothing = drawn_joints(known, camera)
    assert turned is not None
    assert nothing is None
    pixel = [camera.fx * 0.1 + camera.cx, camera.cy]
    np.testing.assert_allclose(turned["path"][0], pixel, atol=0.1)
    np.testing.assert_allclose(np.mean(turned["axis"], axis=0), [camera.cx, camera.cy], atol=2.0)
    assert drawn_joints(replace(known, cam_from_world=None), camera) == [None, None]
    behind = np.diag([1.0, 1.0, -1.0, 1.0])
    assert drawn_joints(replace(known, cam_from_world=behind), camera) == [{}, None]
