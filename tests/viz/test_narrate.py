from __future__ import annotations

from dataclasses import replace

import numpy as np

from quest.types import Joints, State, Tracks
from quest.viz.narrate import narrate

FPS, FRAMES = 10, 41


def tracks_of(points: dict[str, np.ndarray], joints: Joints | None = None) -> Tracks:
    """Tracks of points that are seen all the time, [T, 3] each."""
    world = np.stack(list(points.values()), axis=1).astype(np.float32)
    shape = world.shape[:2]
    return Tracks(
        names=tuple(points), labels=("handle",) * len(points), uv_px=100 + 100 * world[..., :2], point_world=world,
        confidence=np.ones(shape, np.float32), visible=np.ones(shape, bool),
        state=np.full(shape, State.TRACKING.value, dtype="<U8"), stamp_s=np.arange(len(world)) / FPS,
        lost_p=np.zeros(shape, np.float32), alarm=np.zeros(shape, bool), joints=joints,
    )  # fmt: skip


def joints_of(*kinds_and_q: tuple[str, np.ndarray]) -> Joints:
    joints = Joints.unknown(FRAMES, len(kinds_and_q))
    kinds, q = zip(*kinds_and_q, strict=True)
    return replace(joints, kind=kinds, q=np.stack(q, axis=-1).astype(np.float32))


def eased(start: int, stop: int) -> np.ndarray:
    """0 up to a frame, 1 from another one on, evenly in between."""
    return np.clip((np.arange(FRAMES) - start) / (stop - start), 0.0, 1.0)


ANGLE = np.radians(74) * eased(10, 26)
DOOR = np.array([2.0, 1.0, 3.0]) + np.stack([np.cos(ANGLE), np.sin(ANGLE), np.zeros(FRAMES)], axis=-1)
DRAWER = np.array([1.0, 2.0, 3.0]) + 0.31 * eased(0, 16)[:, None] * [0.6, 0.8, 0.0]
STILL = np.tile([0.5, 0.5, 2.0], (FRAMES, 1))
HINGE = ("revolute", ANGLE)
RAIL = ("prismatic", 0.31 * eased(0, 16))
FIXED = ("static", np.full(FRAMES, np.nan))


def test_how_far_and_when_each_joint_moves() -> None:
    tracks = tracks_of({"handle 0": DOOR, "knob 1": DRAWER, "handle 2": STILL}, joints_of(HINGE, RAIL, FIXED))
    assert narrate(tracks) == [
        "handle 0 turned 74° from 1.0 s to 2.6 s.",
        "knob 1 slid 0.31 m from 0.0 s to 1.6 s.",
        "handle 2 stayed where it was, in sight.",
        "No alarm was raised.",
    ]


def test_more_than_half_a_turn_is_not_taken_for_less() -> None:
    q = (np.radians(300) * eased(5, 35) + np.pi) % (2 * np.pi) - np.pi
    assert narrate(tracks_of({"knob": STILL}, joints_of(("revolute", q))))[0].startswith("knob turned 300° ")


def test_what_comes_back_is_told() -> None:
    there_and_back = 0.4 * eased(5, 15) - 0.3 * eased(20, 30)
    sentence = narrate(tracks_of({"handle": STILL}, joints_of(("prismatic", there_and_back))))[0]
    assert sentence == "handle slid 0.40 m and came back to 0.10 m from 0.5 s to 3.0 s."


def test_what_was_only_believed_of_something_out_of_sight_is_no_movement() -> None:
    tracks = tracks_of({"handle": STILL}, joints_of(("prismatic", 0.4 * eased(5, 15) - 0.1 * eased(20, 22))))
    tracks.visible[10:25], tracks.state[10:25] = False, State.HELD.value
    assert narrate(tracks)[0].startswith("handle slid 0.30 m from 0.5 s to 2.5 s and was out of sight")


def test_times_out_of_sight_but_no_flicker() -> None:
    tracks = tracks_of({"handle 0": DOOR, "handle 1": STILL, "handle 2": STILL}, joints_of(HINGE, FIXED, FIXED))
    tracks.visible[21:34, 0] = False
    tracks.visible[7, 1] = False
    tracks.visible[30:, 2] = False
    assert narrate(tracks)[:3] == [
        "handle 0 turned 74° from 1.0 s to 2.6 s and was out of sight from 2.1 s until it was found again at 3.4 s.",
        "handle 2 was out of sight from 3.0 s on.",
        "handle 1 stayed where it was, in sight.",
    ]


def test_alarms_that_clear_and_that_do_not() -> None:
    tracks = tracks_of({"handle 0": DOOR, "handle 1": STILL}, joints_of(HINGE, FIXED))
    assert tracks.alarm is not None
    assert tracks.lost_p is not None
    tracks.alarm[12:20, 1], tracks.alarm[5:, 0] = True, True
    tracks.lost_p[15, 1] = 0.93
    tracks.state[5:, 0] = State.LOST.value
    assert narrate(tracks) == [
        "handle 0 is lost at the end.",
        "handle 1 stayed where it was, in sight.",
        "An alarm for handle 0 opened at 0.5 s (P(lost) up to 0.00) and was still open at the end.",
        "An alarm for handle 1 opened at 1.2 s (P(lost) up to 0.93) and cleared at 2.0 s.",
    ]


def test_what_is_not_known_is_not_told() -> None:
    tracks = tracks_of({"handle 0": DRAWER, "handle 1": STILL, "handle 2": STILL})
    tracks.uv_px[:, 2], tracks.state[:, 2] = np.nan, State.LOST.value
    unwatched = replace(tracks, lost_p=None, alarm=None)
    assert narrate(unwatched) == [
        "handle 0 moved 0.31 m from 0.0 s to 1.6 s.",
        "handle 2 was never found.",
        "handle 1 stayed where it was, in sight.",
    ]
    tracks.point_world[:] = np.nan
    assert "alarm" not in narrate(replace(tracks, lost_p=np.full(tracks.visible.shape, np.nan, np.float32)))[-1]
    assert narrate(tracks)[0] == "handle 0 moved 31 px in the picture from 0.0 s to 1.6 s."


def test_tracks_without_queries_have_no_sentences_of_their_own() -> None:
    assert narrate(tracks_of({"handle": STILL}, joints_of(FIXED)).select([])) == []
