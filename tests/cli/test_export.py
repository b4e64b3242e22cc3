"""``quest export`` and ``--engine`` on the command line."""

from __future__ import annotations

from pathlib import Path

import pytest

import quest
from quest.cli.main import main
from quest.errors import ConfigError
from quest.model.onnx_export import Difference
from quest.model.weights import LoadedNetwork
from quest.track import engine
from tests.paper.tiny import make_paper


def test_it_prints_the_largest_differences(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys):
    def export(loaded: LoadedNetwork, out: Path) -> list[Difference]:
        out.mkdir()
        return [Difference("finder", "place", (640, 480), 2.1e-5)]

    monkeypatch.setattr(engine, "export", export)
    assert main(["export", "--out", str(tmp_path / "exported")]) == 0
    printed = capsys.readouterr().out
    assert "640 x 480" in printed
    assert "2.1e-05" in printed
    assert "within 1e-04" in printed


def test_a_folder_with_something_in_it_is_refused(tmp_path: Path, capsys):
    (tmp_path / "mine").write_text("mine")
    assert main(["export", "--out", str(tmp_path)]) == 2
    assert "not an empty folder" in capsys.readouterr().err


def test_the_published_network_has_no_export(tmp_path: Path, capsys):
    weights = tmp_path / "paper.safetensors"
    make_paper().save(weights, about="a test")
    assert main(["export", "--weights", str(weights), "--out", str(tmp_path / "out")]) == 2
    assert "published network" in capsys.readouterr().err
    with pytest.raises(ConfigError, match="PyTorch alone"):
        quest.load(weights, engine="onnx")


def test_an_engine_that_is_no_folder(tmp_path: Path, capsys):
    assert main(["track", "sample", "--engine", "onx", "--out", str(tmp_path / "out")]) == 2
    assert "onx/manifest.json: no such file; expected a folder of `quest export`, or torch, bfloat16 or onnx" in (
        " ".join(capsys.readouterr().err.split())
    )
