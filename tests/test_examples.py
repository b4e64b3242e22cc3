"""The examples, as far as they can be tried without a renderer: the commands that they run exist."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from quest.cli.main import parse
from quest.errors import QuestError
from quest.train.settings import TrainingConfig
from tests.track.clips import make_clip, make_tracker

EXAMPLES = Path(__file__).parents[1] / "examples"


def example(name: str) -> Any:
    """An example as a module."""
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("procedural", [0, 3])
def test_fine_tuning_runs_commands_that_exist(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, procedural: int):
    module, commands = example("fine_tune"), []
    monkeypatch.setattr(subprocess, "run", lambda command, check: commands.append(command[3:]))
    monkeypatch.setattr(module.FineTune, "compare", lambda self: None)
    (tmp_path / "takes" / "held-out" / "one.zarr").mkdir(parents=True)
    module.FineTune(out=tmp_path, procedural=procedural).run()
    names = [words[0] for words in commands]
    generate = ["generate"] * (4 if procedural else 3)
    assert names == [*generate, "eval", "train", "weights", "eval"]
    for words in commands:
        parse(words)
    train: Any = parse(commands[names.index("train")])
    assert len(train.data) == (2 if procedural else 1)
    assert train.training.learning_rate < 0.1 * TrainingConfig().learning_rate
    held_out = str(tmp_path / "takes" / "held-out")
    assert held_out not in (*train.data, *train.validation)
    evaluated: list[Any] = [parse(words) for words in commands if words[0] == "eval"]
    assert [command.takes for command in evaluated] == [held_out, held_out]


def test_every_object_has_a_run_of_its_own():
    module = example("fine_tune")
    assert module.FineTune().folder == Path("runs/toolbox")
    assert module.FineTune(objects=("path/to/mine",)).folder == Path("runs/mine")
    assert module.FineTune(objects=("path/to/arm.urdf",)).folder == Path("runs/arm")
    assert module.FineTune(out=Path("elsewhere")).folder == Path("elsewhere")


def test_the_tool_chest_has_three_handles():
    text = (EXAMPLES / "toolbox" / "toolbox.urdf").read_text(encoding="utf-8")
    assert text.count('type="prismatic"') == 2
    assert text.count('type="revolute"') == 1


def test_arrays_of_ones_own_are_tracked():
    tracks = example("own_arrays").follow(make_tracker(), make_clip())
    assert tracks.names == ("mine",)
    assert tracks.uv_px.shape == (6, 1, 2)


def test_both_rims_of_a_laptop_are_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    module, commands = example("open_and_lift"), []
    tracks = module.follow(make_tracker(), make_clip())
    assert tracks.names == ("opens", "lifts")
    point_world = np.full_like(tracks.point_world, np.nan)
    point_world[-3:, 0] = [[0, 0, 1], [0, 2, 1], [0.3, 0.4, 1]]
    first, second = module.travelled_m(replace(tracks, point_world=point_world))
    assert first == pytest.approx(0.5)
    assert np.isnan(second)
    monkeypatch.setattr(subprocess, "run", lambda command, check: commands.append(command[3:]))
    with pytest.raises(QuestError):
        module.OpenAndLift(out=tmp_path / "none").render()
    parse(commands[0])
