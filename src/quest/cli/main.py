"""The program ``quest``: picks a command, turns errors into one line and an exit code."""

from __future__ import annotations

import difflib
import errno
import importlib
import io
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NoReturn, Protocol, runtime_checkable

import tyro
from rich.text import Text

from quest.cli.console import Console
from quest.errors import QuestError
from quest.extras import explain_missing

EXIT_ERROR = 2
EXIT_INTERRUPTED = 130
EXIT_BROKEN_PIPE = 141

_PLACES = (
    *(errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC, errno.EDQUOT),
    *(errno.EEXIST, errno.EISDIR, errno.ENOTDIR, errno.ENAMETOOLONG),
)
"""Errors of a place for files, and not of the program."""

DESCRIPTION = "Follow handles, knobs, rims and fronts of articulated objects in RGB-D video."


@runtime_checkable
class Command(Protocol):
    """A command's dataclass: its fields are the arguments."""

    def run(self) -> int:
        """Do the work and return the exit code."""
        ...


@dataclass(frozen=True)
class Entry:
    """A command in a list of commands; its module is imported when it is asked for."""

    module: str
    """Module below ``quest.cli``."""
    name: str
    """The command's dataclass in it."""
    summary: str
    """One line for the list."""
    words: tuple[str, ...] = ()
    """Arguments that come before those that are given."""

    def load(self) -> type[Command]:
        """The command's dataclass."""
        return getattr(importlib.import_module(f"quest.cli.{self.module}"), self.name)


@dataclass(frozen=True)
class Group:
    """Commands that share their first word."""

    summary: str
    """One line for the list."""
    commands: Mapping[str, Entry]
    """By their second word."""


_TABLES = {
    "all": "All of these tables; --smoke tries them in minutes.",
    "comparison": "Every tracker at every level.",
    "levels": "The published network without its queries, 3D or smoothness; chained flow.",
    "window": "Windows of 2, 4 and 8 frames.",
    "slots": "4, 8 and 16 learned queries.",
    "losses": "Each loss left out.",
    "remedies": "What helps the published network to learn.",
    "noise": "Every tracker on noisy colours.",
    "drift": "Distance over the course of a take.",
    "failures": "Long occlusions, and banks of like doors.",
    "intents": "What opens a laptop and what lifts it.",
    "speed": "Time and memory of every tracker.",
}

COMMANDS: dict[str, Entry | Group] = {
    "track": Entry("track", "Track", "Track a recording or a take: a table of tracks and a video."),
    "find": Entry("find", "Find", "Find what can be taken hold of in a picture."),
    "report": Entry("report", "Report", "Write a page about a run of quest track: words, plots, video, settings."),
    "pick": Entry("live", "Pick", "Choose what to follow in a recording, on a local page."),
    "live": Entry("live", "Live", "Follow a camera on a local page, and correct what is followed."),
    "monitor": Entry("monitor", "Monitor", "Watch a recording or a camera in the terminal: states, joints, alarms."),
    "demo": Entry("track", "Demo", "Track the packaged clips, and say which video to open."),
    "doctor": Entry("doctor", "Doctor", "Check this machine: devices, renderer, weights, extras."),
    "weights": Group(
        "List, show, share and tune weights.",
        {
            "list": Entry("weights", "ListWeights", "List the weights that come with the package."),
            "show": Entry("weights", "ShowWeights", "Print the content of a file of weights."),
            "save": Entry("weights", "SaveWeights", "Write weights into a folder in the form of the hub."),
            "push": Entry("weights", "PushWeights", "Push weights and a card to the Hugging Face hub."),
            "import-encoder": Entry("weights", "ImportEncoder", "Make the vision transformer's initial weights."),
            "import-detail": Entry("weights", "ImportDetail", "Make EfficientNet's initial weights."),
            "tune": Entry("weights", "TuneWeights", "Choose the threshold of discovery."),
        },
    ),
    "data": Group(
        "Look at takes, verify them, and export them.",
        {
            "ls": Entry("data", "DataLs", "List the takes of a store."),
            "show": Entry("data", "DataShow", "Draw a take or a store, or write a Rerun recording."),
            "stats": Entry("data", "DataStats", "Count the takes, entities and motions of a store."),
            "verify": Entry("data", "DataVerify", "Check the ground truth of takes."),
            "export": Entry("data", "DataExport", "Write takes as TAPVid-3D, LeRobot or MCAP."),
        },
    ),
    "objects": Group(
        "Look at the objects of the simulator, or at your own.",
        {
            "list": Entry("objects", "ObjectsList", "List objects with their joints, entities and sizes."),
            "show": Entry("objects", "ObjectsShow", "Draw objects with their entities."),
            "import": Entry("objects", "ObjectsImport", "Make objects of furniture libraries of Sweet Home 3D."),
        },
    ),
    "export": Entry("export", "Export", "Write the tracker's networks as ONNX."),
    "generate": Entry("generate", "Generate", "Render simulated takes with ground truth into a take store."),
    "train": Entry("train", "Train", "Train a network on takes."),
    "eval": Entry("evaluate", "Eval", "Score trackers."),
    "bench": Group(
        "Make the tables of the publication, and score trackers on the benchmarks of others.",
        {
            **{name: Entry("bench", "BenchTable", about, (name,)) for name, about in _TABLES.items()},
            "tapvid": Entry("bench", "BenchTapvid", "TAP-Vid and TAPVid-3D, in two or three dimensions."),
        },
    ),
    "calibrate": Entry("calibrate", "Calibrate", "Fit the monitor to takes."),
    "eval-monitor": Entry("calibrate", "EvalMonitor", "Score the monitor beside plainer rules."),
}
"""Every command by its name on the command line, in the order of the help."""


def parse(arguments: Sequence[str]) -> Command:
    """Parse the words after ``quest`` into a command.

    Raises:
        SystemExit: on ``--help`` (code 0) and on bad arguments (code 2, after a message on stderr).
    """
    here: Group = Group(DESCRIPTION, {})
    commands: Mapping[str, Entry | Group] = COMMANDS
    words, rest = ["quest"], list(arguments)
    while True:
        if not rest or rest[0] in ("-h", "--help"):
            print(_help(" ".join(words), here.summary, commands))
            raise SystemExit(0)
        chosen = commands.get(rest[0])
        if chosen is None:
            _unknown(" ".join(words), rest[0], commands)
        words.append(rest.pop(0))
        if isinstance(chosen, Entry):
            config = (tyro.conf.HelptextFromCommentsOff,)
            return tyro.cli(chosen.load(), prog=" ".join(words), args=[*chosen.words, *rest], config=config)
        here, commands = chosen, chosen.commands


def _help(program: str, description: str, commands: Mapping[str, Entry | Group]) -> str:
    """The list of commands."""
    top = commands is COMMANDS
    lines = [f"usage: {program} COMMAND ...", *(["       quest --version"] if top else []), "", description, ""]
    lines += [f"  {name:<16}{command.summary}" for name, command in commands.items()]
    lines += ["", f"{program} COMMAND --help explains a command."]
    return "\n".join([*lines, "To begin: quest track sample"] if top else lines)


def _unknown(program: str, word: str, commands: Mapping[str, Entry | Group]) -> NoReturn:
    """Say which commands there are, the likeliest first."""
    close = difflib.get_close_matches(word, commands, n=3, cutoff=0.5)
    advice = f"did you mean {' or '.join(close)}?" if close else f"expected one of {', '.join(commands)}"
    _fail(QuestError(f"{program}: no command {word!r}; {advice} ({program} --help lists them)"))
    raise SystemExit(EXIT_ERROR)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``quest`` with the arguments of the process, or with others.

    Returns:
        The exit code: the command's own, 2 for an error that the user can mend, 130 when interrupted, 141 when nobody
        reads the output any more.
    """
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="backslashreplace")  # names may have letters that the terminal lacks
    try:
        code = _run(sys.argv[1:] if arguments is None else arguments)
        print(end="", flush=True)
        return code
    except BrokenPipeError:
        # As in `quest --help | head -1`. Nothing can be flushed at exit either.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_BROKEN_PIPE
    except SystemExit as stop:
        if isinstance(stop.__context__, BrokenPipeError):  # rich has silenced standard output already
            return EXIT_BROKEN_PIPE
        raise


def _run(arguments: Sequence[str]) -> int:
    if list(arguments) == ["--version"]:
        from quest import __version__

        print(f"quest {__version__}")
        return 0
    try:
        return parse(arguments).run()
    except QuestError as error:
        return _fail(error)
    except ModuleNotFoundError as error:
        explained = explain_missing(error)
        if explained is None:
            raise
        return _fail(explained)
    except OSError as error:
        if error.errno not in _PLACES:
            raise
        place = "" if error.filename is None else f"{os.fsdecode(error.filename)}: "
        return _fail(QuestError(f"{place}cannot be written or read ({error.strerror}); name another place"))
    except KeyboardInterrupt:
        Console(stderr=True).print("interrupted", style="yellow")
        return EXIT_INTERRUPTED


def _fail(error: QuestError) -> int:
    message = " ".join(str(error).split())
    Console(stderr=True).print(Text.assemble(("error:", "bold red"), " ", (message, "red")))
    return EXIT_ERROR


if __name__ == "__main__":
    sys.exit(main())
