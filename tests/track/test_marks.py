"""The point under a user's pixel, carried along with what the network follows."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from quest.grounding import Joint, JointKind
from quest.model.decoder import Prediction
from quest.model.observation import FrameBatch
from quest.track.following import Following
from quest.track.grounded import Ground
from quest.track.marks import beside, marked
from quest.track.saving import load, save
from quest.track.settings import TrackerConfig
from tests.tiny import make_frames

ASKED_PX = torch.tensor([30.0, 20.5])
OWN = np.array([[0.1, 0.2, 0.3]])


def make_query() -> Following:
    return Following(0, "handle", None, Ground(TrackerConfig()), asked_px=ASKED_PX)


def make_prediction(uv_px: torch.Tensor) -> Prediction:
    """A network that sees one query at a pixel."""
    none, one = torch.zeros(1, 1, 1, 0), torch.zeros(1, 1, 1)
    return Prediction(none, none, one.long(), uv_px[None, None, None] / 64, torch.zeros(1, 1, 1, 3), one, one)


def plain_frames(depth_m: float = 2.0) -> FrameBatch:
    frames = make_frames(batch=1, frames=1)
    frames.depth_m[:] = depth_m
    return frames


def under_pixel(frames: FrameBatch) -> np.ndarray:
    at = ASKED_PX[None, None, None]
    return frames.to_reference(at, frames.depth_at(at))[0, 0].double().numpy()


def test_first_answer_is_the_point_that_was_asked_for():
    frames, query = plain_frames(), make_query()
    shown = marked([query], OWN, make_prediction(ASKED_PX + 3), frames)
    np.testing.assert_allclose(shown, under_pixel(frames), atol=1e-6)
    assert query.asked_px is None
    later = marked([query], OWN + 0.05, make_prediction(ASKED_PX + 20), frames)
    np.testing.assert_allclose(later, shown + 0.05, atol=1e-9)


@pytest.mark.parametrize("away", [False, True])
def test_without_depth_or_the_same_thing_in_sight_the_network_alone_answers(away: bool):
    frames, query = plain_frames(2.0 if away else 0.0), make_query()
    shown = marked([query], OWN, make_prediction(ASKED_PX + (6 if away else 0)), frames)
    np.testing.assert_array_equal(shown, OWN)
    assert query.mark is None
    assert query.asked_px is None


def test_without_depth_pixels_are_those_that_were_asked_for():
    frames, query, uv = plain_frames(0.0), make_query(), (ASKED_PX - 3)[None] / 64
    shown = marked([query], np.full((1, 3), np.nan), make_prediction(ASKED_PX - 3), frames)
    torch.testing.assert_close(beside([query], uv, shown, size=64) * 64, ASKED_PX[None])
    torch.testing.assert_close(beside([query], uv + 0.25, shown, size=64) * 64, ASKED_PX[None] + 16)
    # With depth the place tells, but for frames that have none.
    query = make_query()
    shown = marked([query], OWN, make_prediction(ASKED_PX - 3), plain_frames())
    torch.testing.assert_close(beside([query], uv, shown, size=64), uv)
    torch.testing.assert_close(beside([query], uv, np.full((1, 3), np.nan), size=64) * 64, ASKED_PX[None])


def test_a_mark_turns_with_the_link(monkeypatch: pytest.MonkeyPatch):
    frames, query = plain_frames(), make_query()
    marked([query], OWN, make_prediction(ASKED_PX), frames)
    query.move(OWN[0], held=False, embedding=torch.zeros(4))
    axis, hinge = np.array([0.0, 1.0, 0.0]), OWN[0] - [0.5, 0.0, 0.0]
    door = Joint(JointKind.REVOLUTE, axis, hinge, OWN[0], 0.0, 1.5, np.eye(6), 0.01, 20)
    monkeypatch.setattr(Ground, "joint", door)
    angle = 1.2
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    own = turn @ (OWN[0] - hinge) + hinge
    expected = turn @ (under_pixel(frames)[0] - hinge) + hinge
    shown = marked([query], own[None], make_prediction(ASKED_PX), frames)
    np.testing.assert_allclose(shown[0], expected, atol=1e-6)


def test_marks_are_saved_and_end_with_their_reference_frame():
    query = make_query()
    marked([query], OWN, make_prediction(ASKED_PX), plain_frames())
    again = load(save(query), Following)
    assert query.mark is not None
    assert again.mark is not None
    np.testing.assert_array_equal(again.mark, query.mark)
    assert again.mark_px is not None
    np.testing.assert_array_equal(again.mark_px, query.mark_px)
    again.forget_places(TrackerConfig())
    assert again.mark is None
