"""Joints of predicted tracks against the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.predicted_joints import (
    FAR,
    JointAnswer,
    axis_error_deg,
    joint_rows,
    judge_view,
    moments_of,
)
from quest.filter.joints import JointKind
from quest.types import Take
from tests.synthetic import make_take
from tests.track.clips import make_tracker


@pytest.fixture(scope="module")
def take() -> Take:
    """A drawer and a door, one after the other; each goes far."""
    return make_take(frames=24, views=1, entities=2, size=(64, 64), seed=0)


def answer(**changes) -> JointAnswer:
    plain = JointAnswer(
        "t", 0, "e", "o", "validation", "procedural", "standard", 1, "far", 9, "revolute", "revolute", 3.0
    )
    return replace(plain, **changes)


def test_when_joints_are_judged(take: Take):
    moments = moments_of(take)
    assert set(moments) == {0, 1}
    for e, kind in ((0, JointKind.PRISMATIC), (1, JointKind.REVOLUTE)):
        (far,) = [t for t, names in moments[e].items() if "far" in names]
        assert take.joint_position[far, e] >= FAR[kind] > take.joint_position[far - 1, e]
        assert "end" in moments[e][len(take) - 1]
    near = replace(take, joint_position=take.joint_position * 0.4)
    assert all(names == {len(take) - 1: ("end",)} for names in moments_of(near).values())
    carried = replace(take, info=replace(take.info, moved_joints=(1,)))
    assert set(moments_of(carried)) == {1}
    first, second = take.info.entities[:2]
    fixed = replace(take, info=replace(take.info, entities=(first, replace(second, link=0, joint=-1))))
    assert set(moments_of(fixed)) == {0}


def test_far_at_the_last_frame_is_both(take: Take):
    late = np.zeros_like(take.joint_position)
    late[-1] = 1.0
    assert moments_of(replace(take, joint_position=late))[0] == {len(take) - 1: ("far", "end")}


def test_angle_of_axes_as_lines():
    x, y = np.array([1.0, 0, 0]), np.array([0, 1, 0], np.float32)
    assert axis_error_deg(x, y) == pytest.approx(90)
    assert axis_error_deg(-x, x.astype(np.float32)) == pytest.approx(0)
    turned = np.array([np.cos(0.1), np.sin(0.1), 0], np.float32)
    assert axis_error_deg(x, turned) == pytest.approx(np.degrees(0.1), abs=1e-4)


def test_rows():
    answers = [answer(object_id=f"o{i}", axis_error_deg=float(i)) for i in range(5)]
    answers += [
        answer(object_id="o5", said="static", axis_error_deg=None),
        answer(object_id="o6", said="none", axis_error_deg=None),
        answer(object_id="o7", said="prismatic", axis_error_deg=80.0, level=4),
        answer(moment="end"),
        answer(kind="prismatic"),
    ]
    rows = {(r["kind"], r["moment"]): r for r in joint_rows(answers, resamples=100, seed=0)}
    assert set(rows) == {("revolute", "far"), ("revolute", "end"), ("prismatic", "far")}
    row = rows["revolute", "far"]
    assert [row[name] for name in ("answers", "objects", "without", "static", "levels")] == [8, 8, 1, 1, [1, 4]]
    assert (row["kind_right"].mean, row["kind_right"].count) == (5 / 8, 8)
    assert (row["axis_error_deg"].mean, row["axis_error_deg"].count) == (2.0, 5)
    assert rows["prismatic", "far"]["axis_error_deg"] is None


def test_a_view_is_judged(take: Take):
    tracker = make_tracker()
    answers = judge_view(tracker, take, 0, part="unlisted")
    assert {(a.entity, a.moment) for a in answers} == {
        (name, moment) for name in ("link_0/handle", "link_1/knob") for moment in ("far", "end")
    }
    assert len(answers) == 4
    assert [a.frame for a in answers] == sorted(a.frame for a in answers)
    for a in answers:
        assert a.said in ("none", "static", "prismatic", "revolute")
        assert (a.axis_error_deg is None) == (a.said in ("none", "static"))
        assert a.kind == ("prismatic" if a.entity.startswith("link_0") else "revolute")
    still = replace(take, point_world=np.repeat(take.point_world[:1], len(take), axis=0))
    assert judge_view(tracker, still, 0, part="unlisted") == ()
