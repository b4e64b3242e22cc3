from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

import pytest

from quest import __version__
from quest.cli import main as program
from quest.errors import MissingExtraError, QuestError, RecordingError
from quest.extras import EXTRA_OF, explain_missing, install_command, require


@dataclass(frozen=True)
class Raises:
    error: BaseException

    def run(self) -> int:
        raise self.error


def run_with(monkeypatch, error: BaseException) -> int:
    monkeypatch.setattr(program, "parse", lambda arguments: Raises(error))
    return program.main(["track"])


def python(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command, env = [sys.executable, *arguments], os.environ | environment
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=240, env=env)


def test_version(capsys):
    assert program.main(["--version"]) == 0
    assert capsys.readouterr().out == f"quest {__version__}\n"


def test_runs_as_a_module():
    done = python("-m", "quest.cli.main", "--version")
    assert (done.returncode, done.stdout) == (0, f"quest {__version__}\n")


@pytest.mark.parametrize("arguments", [[], ["--help"]])
def test_help_lists_the_commands_that_one_needs_first(arguments, capsys):
    with pytest.raises(SystemExit) as stop:
        program.main(arguments)
    assert stop.value.code == 0
    out = capsys.readouterr().out
    listed = [line.split()[0] for line in out.splitlines() if line[:2] == "  " != line[1:3]]
    assert [name for name in listed if name in program.COMMANDS] == list(program.COMMANDS)
    assert listed[:2] == ["track", "find"]
    assert "quest --version" in out


def every_command() -> list[list[str]]:
    words = [[name] for name in program.COMMANDS]
    return words + [[n, w] for n, c in program.COMMANDS.items() if isinstance(c, program.Group) for w in c.commands]


@pytest.mark.parametrize("words", every_command(), ids=" ".join)
def test_every_command_has_help(words, capsys):
    with pytest.raises(SystemExit) as stop:
        program.main([*words, "--help"])
    assert stop.value.code == 0
    assert f"usage: quest {' '.join(words)}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "advice"),
    [
        (["trak", "sample"], "no command 'trak'; did you mean track"),
        (["weights", "lst"], "quest weights: no command 'lst'; did you mean list?"),
        (["xyzzy"], "expected one of track, find,"),
    ],
)
def test_misspelt_commands(words, advice, capsys):
    with pytest.raises(SystemExit) as stop:
        program.main(words)
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert advice in error
    assert error.count("\n") == 1


def test_help_imports_nothing_heavy():
    """Help must come at once: what is slow to import is imported by the commands that run."""
    heavy = ("torch", "sapien", "cv2", "av", "pyarrow", "scipy", "zarr", "matplotlib")
    code = f"import sys, quest.cli.main; print([m for m in {heavy!r} if m in sys.modules])"
    done = python("-c", code)
    assert done.stdout == "[]\n", done.stderr


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["track", "sample", "--ot", "x"], "--out"),
        (["doctor", "--colour", "red"], "--colour"),
        (["train"], "--out"),
    ],
)
def test_bad_options_are_those_of_the_command_that_was_called(arguments, said, capsys):
    with pytest.raises(SystemExit) as stop:
        program.main(arguments)
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert said in error
    assert "--protocol" not in error


def test_an_error_of_ours_is_one_line(monkeypatch, capsys):
    message = "clip [red]: expected 3 frames,\n got 2; " + "give all of them " * 20
    assert run_with(monkeypatch, RecordingError(message)) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("error: clip [red]: expected 3 frames, got 2; give all")
    assert captured.err.count("\n") == 1


def test_other_errors_are_not_hidden(monkeypatch):
    with pytest.raises(ZeroDivisionError):
        run_with(monkeypatch, ZeroDivisionError())


def test_places_that_cannot_be_used_are_one_line(monkeypatch, capsys):
    assert run_with(monkeypatch, OSError(errno.EACCES, "Permission denied", "/locked/sheet.png")) == 2
    error = capsys.readouterr().err
    assert error == "error: /locked/sheet.png: cannot be written or read (Permission denied); name another place\n"
    assert run_with(monkeypatch, OSError(errno.ENOSPC, "No space left on device")) == 2
    assert capsys.readouterr().err.startswith("error: cannot be written or read (No space left")
    with pytest.raises(OSError, match="Input/output error"):
        run_with(monkeypatch, OSError(errno.EIO, "Input/output error"))


def test_interrupted(monkeypatch):
    assert run_with(monkeypatch, KeyboardInterrupt()) == 130


def test_missing_extra_is_named(monkeypatch, capsys):
    assert run_with(monkeypatch, ModuleNotFoundError("No module named 'sapien'", name="sapien")) == 2
    assert install_command("sim") in capsys.readouterr().err
    with pytest.raises(ModuleNotFoundError):
        run_with(monkeypatch, ModuleNotFoundError("No module named 'fish'", name="fish"))


def test_tracking_and_help_need_neither_an_extra_nor_what_pytorch_compiles_with():
    """Nothing on the way may import what an extra brings, though the motions of cameras come from the simulator."""
    code = (
        f"import sys; sys.modules.update(dict.fromkeys({sorted(EXTRA_OF)!r}))\n"
        "import quest.track, quest.data.recording, quest.tracks, quest.viz.overlay, quest.evaluation\n"
        "import quest, quest.baselines; quest.load()\n"
        "print([m for m in ('torch._dynamo', 'torch.fx.experimental.symbolic_shapes', 'sympy') if m in sys.modules])\n"
        "from quest.cli.main import main; main(['generate', '--help'])"
    )
    done = python("-c", code)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("[]\n")
    assert "static,orbit,handheld,pan,walk,mixed" in done.stdout


def test_require(monkeypatch):
    assert require("json") is json
    monkeypatch.setitem(EXTRA_OF, "quest_not_there", "sim")
    with pytest.raises(MissingExtraError, match=r"quest_not_there.*pip install .*\[sim\]"):
        require("quest_not_there.submodule")
    with pytest.raises(ModuleNotFoundError) as caught:
        require("fish")
    assert not isinstance(caught.value, QuestError)
    assert explain_missing(ModuleNotFoundError("?")) is None


def test_extras_are_those_of_the_distribution():
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    other_name = {"rerun": "rerun-sdk", "mcap_ros2": "mcap-ros2-support"}
    for module, extra in EXTRA_OF.items():
        names = [requirement.split(">")[0].split("=")[0] for requirement in project["optional-dependencies"][extra]]
        package = other_name.get(module, module.replace("_", "-"))
        assert package in names, f"{module}: {install_command(extra)} does not install it"


def test_commands_name_the_extra_that_they_miss(tmp_path):
    code = (
        "import sys; from quest.cli.main import main\n"
        "sys.modules.update(sapien=None, trimesh=None)\n"
        "print(*(main(['generate', '--out', sys.argv[1], *more]) for more in ([], ['--procedural', '1'])))"
    )
    done = python("-c", code, str(tmp_path / "takes"))
    assert done.stdout == "2 2\n", done.stderr
    assert done.stderr.count(install_command("sim")) == 2
    assert "Traceback" not in done.stderr


def test_doctor_and_weights(capsys):
    assert program.main(["doctor"]) == 0
    out = capsys.readouterr().out
    assert all(part in out for part in ("torch", "video", "weights", "renderer", "[sim]", "disk"))
    assert program.main(["doctor", "--json"]) == 0
    parts = {finding["part"]: finding for finding in json.loads(capsys.readouterr().out)}
    assert parts["torch"]["status"] == "ok"
    assert set(parts["disk"]) == {"part", "status", "found", "remedy"}
    assert program.main(["weights", "list", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert {weights["name"] for weights in listed} >= {"quest-s16"}
    assert all(Path(weights["file"]).stat().st_size == weights["bytes"] for weights in listed)


def test_doctor_fails_without_weights(monkeypatch, capsys):
    monkeypatch.setattr("quest.model.weights.shipped_weights", dict)
    assert program.main(["doctor"]) == 1
    assert "cannot track recordings here: weights" in capsys.readouterr().out


@pytest.mark.parametrize("words", ["print('x')", "Console().print('x')"])
def test_nobody_reads_what_a_command_prints(words):
    """Neither rich's own exit code, which means something else here, nor a complaint of Python's at the end."""
    code = (
        "import sys, quest.cli.main as program\n"
        "from rich.console import Console\n"
        f"class Says:\n    def run(self):\n        {words}\n        return 0\n"
        "program.parse = lambda arguments: Says()\n"
        "sys.exit(program.main(['ls']))"
    )
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run([sys.executable, "-c", code], stdout=writer, stderr=subprocess.PIPE, check=False, timeout=60)
    os.close(writer)
    assert (done.returncode, done.stderr) == (141, b"")


def test_letters_that_the_terminal_lacks():
    code = (
        "import sys, quest.cli.main as program\n"
        "class Says:\n    def run(self):\n        print('\u628a')\n        return 0\n"
        "program.parse = lambda arguments: Says()\n"
        "sys.exit(program.main(['ls']))"
    )
    done = python("-c", code, PYTHONIOENCODING="latin-1:strict")
    assert (done.returncode, done.stdout) == (0, "\\u628a\n")
