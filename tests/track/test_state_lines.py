from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from quest.errors import InputError
from quest.filter.joints import Joint, JointKind
from quest.track.state_lines import StateLines, state_line
from quest.types import State
from tests.track.test_events import ALARM, make_state

HINGE = Joint(JointKind.REVOLUTE, np.array([0.0, 0, 1]), np.zeros(3), np.array([0.5, 0, 0]), 0.0, 1.0, np.eye(4))
DOOR = replace(make_state(), point_world=np.array([[0, 0.5, 0], [np.nan] * 3], np.float32))


def queries(**changes: object) -> list[dict]:
    return json.loads(state_line(replace(DOOR, **changes), frame=0))["queries"]


def test_fields():
    line = json.loads(state_line(replace(DOOR, stamp_s=1.7e9 + 0.125, flags=("no depth",)), frame=12))
    assert (line["frame"], line["stamp_s"], line["flags"]) == (12, 1.7e9 + 0.125, ["no depth"])
    assert [q["query"] for q in line["queries"]] == [4, 7]
    assert list(line["queries"][0]) == [
        *["query", "name", "label", "state", "visible", "uv_px", "point_world", "confidence", "lost_p", "joint"],
        "alarm",
    ]
    assert line["queries"][0]["confidence"] == 0.9
    assert line["queries"][0]["state"] == State.TRACKING
    assert line["queries"][1]["label"] is None


def test_unknown_is_null():
    left, right = queries(lost_p=np.array([0.25, np.nan], np.float32))
    assert (left["lost_p"], right["lost_p"]) == (0.25, None)
    assert right["point_world"] == [None] * 3
    assert right["joint"] is None


def test_joint():
    left, right = queries(joint=(HINGE, HINGE), q=np.array([np.pi / 2, np.nan], np.float32))
    joint = left["joint"]
    assert joint["kind"] == "revolute"
    assert joint["axis"] == [0, 0, 1]
    assert joint["origin_m"] == [0, 0, 0]
    assert joint["q"] == pytest.approx(np.pi / 2, rel=1e-5)
    assert joint["q_seen"] == [0, 1]
    assert right["joint"]["q"] is None


def test_what_is_static_has_no_axis():
    still = replace(HINGE, kind=JointKind.STATIC, covariance=np.eye(3))
    assert queries(joint=(still, None))[0]["joint"] == {
        "kind": "static", "axis": None, "origin_m": [0, 0, 0], "q": None, "q_seen": None
    }  # fmt: skip


def test_alarm():
    left, right = queries(alarm=(ALARM, None))
    assert left["alarm"]["reason"] == ALARM.reason
    assert left["alarm"]["frame"] == 2
    assert right["alarm"] is None


def test_lines_can_be_followed(tmp_path: Path):
    path = tmp_path / "lines.jsonl"
    path.write_text("old")
    with StateLines(path) as lines:
        for t in range(3):
            lines.write(DOOR, frame=t)
            assert len(path.read_text().splitlines()) == t + 1


def test_a_folder_is_no_file(tmp_path: Path):
    with pytest.raises(InputError, match="name another file"):
        StateLines(tmp_path)
