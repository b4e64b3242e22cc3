"""An inventory of what users may rely on: changing it is a decision, so this file has to change with it."""

from __future__ import annotations

import inspect

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

COMMANDS = ["data", "doctor", "eval", "eval-monitor", "generate", "monitor", "objects", "track", "train", "weights"]

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
