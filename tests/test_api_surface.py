"""An inventory of what users may rely on: changing it is a decision, so this file has to change with it."""

from __future__ import annotations

import inspect
import re
from dataclasses import fields, is_dataclass

import pytest

import quest

PUBLIC = [
    "LABELS",
    "Camera",
    "Clip",
    "Frame",
    "Joints",
    "Query",
    "QuestError",
    "State",
    "Stream",
    "StreamState",
    "Tracker",
    "Tracks",
    "load",
    "read",
]

MEMBERS = {
    "Camera": "cx cy from_fov from_opencv fx fy height matrix width",
    "Clip": "cam_from_world camera depth_m frame from_arrays name notes rgb stamp_s",
    "Frame": "cam_from_world depth_m rgb stamp_s",
    "Joints": "axis axis_sigma_rad covariance describe kind origin origin_sigma_m q q_max_seen q_min_seen rest select "
    "unknown",
    "Query": "box frame intent kind label mask name point semantic slot text uv_px words",
    "State": "HELD LOST TRACKING",
    "Stream": "add budget camera confirm frame looking memory noise on_alarm place rename retire step unbound",
    "StreamState": "alarm cam_from_world confidence flags has_depth joint labels lost_log_odds lost_p names only "
    "point_world q query stamp_s state uv_px visible",
    "Tracker": "calibrations config device features find name network noise restore save stream track weights_hash",
    "Tracks": "alarm cam_from_world confidence describe frame_flags joints labels lost_p names point_world save "
    "select stamp_s state to_pandas uv_px visible",
}
"""Fields, methods and properties of the public classes."""

COMMANDS = [
    *("bench", "calibrate", "data", "demo", "doctor", "eval", "eval-monitor", "export"),
    *("find", "generate", "live", "monitor", "objects", "pick", "report", "track", "train", "weights"),
]

ERRORS = [
    "ConfigError",
    "InputError",
    "MissingExtraError",
    "ObjectError",
    "QuestError",
    "RecordingError",
    "RendererError",
    "TakeError",
    "WeightsError",
]


def test_public_names():
    assert sorted(quest.__all__) == sorted(PUBLIC)


@pytest.mark.parametrize("name", PUBLIC)
def test_public_names_exist_and_are_explained(name):
    value = getattr(quest, name)
    if inspect.isclass(value) or inspect.isroutine(value):
        assert inspect.getdoc(value)


def members(owner: type) -> set[str]:
    """Public fields, methods and properties of a class, and what its objects are given when they are made."""
    own = {field.name for field in fields(owner)} if is_dataclass(owner) else set()
    own |= set(re.findall(r"self\.([a-z]\w*)(?:: [^=\n]+)? = ", inspect.getsource(owner)))
    return own | {name for name in dir(owner) if not name.startswith("_")}


@pytest.mark.parametrize("name", MEMBERS)
def test_members_of_public_classes(name):
    owner = getattr(quest, name)
    inherited = set(dir(str)) if issubclass(owner, str) else set()
    assert sorted(members(owner) - inherited) == MEMBERS[name].split()


def test_members_are_listed_of_every_public_class():
    classes = {name for name in PUBLIC if inspect.isclass(getattr(quest, name))}
    assert classes - {"QuestError"} == set(MEMBERS)


def test_commands():
    from quest.cli import main

    assert sorted(main.COMMANDS) == COMMANDS
    entries = [e for c in main.COMMANDS.values() for e in ([c] if isinstance(c, main.Entry) else c.commands.values())]
    assert all(entry.summary and inspect.getdoc(entry.load()) and callable(entry.load().run) for entry in entries)


def test_errors_are_one_family():
    from quest import errors

    found = {name: value for name, value in vars(errors).items() if inspect.isclass(value)}
    assert sorted(found) == ERRORS
    assert all(issubclass(error, errors.QuestError) for error in found.values())


def test_tracker_door():
    """What DESIGN promises of the tracker: one door for clips, one for streams."""
    assert list(inspect.signature(quest.Tracker.track).parameters)[:3] == ["self", "clip", "queries"]
    assert list(inspect.signature(quest.Tracker.stream).parameters)[:3] == ["self", "camera", "queries"]
    assert list(inspect.signature(quest.Clip.from_arrays).parameters)[:3] == ["rgb", "depth_m", "camera"]
    assert all(callable(getattr(quest.Tracks, name)) for name in ("to_pandas", "save", "select"))
    assert next(iter(inspect.signature(quest.load).parameters.values())).default == "quest-s16"
