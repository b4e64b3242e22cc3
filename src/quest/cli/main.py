"""The program ``quest``: picks a command, turns errors into one line and an exit code."""

from __future__ import annotations

import errno
import io
import os
import sys
from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

import tyro
from rich.console import Console
from rich.markup import escape

from quest.cli.data import Data
from quest.cli.doctor import Doctor
from quest.cli.evaluate import Eval
from quest.cli.evaluate_monitor import EvalMonitor
from quest.cli.generate import Generate
from quest.cli.monitor import Monitor
from quest.cli.objects import Objects
from quest.cli.track import Track
from quest.cli.train import Train
from quest.cli.weights import Weights
from quest.errors import QuestError
from quest.extras import explain_missing

EXIT_ERROR = 2
EXIT_INTERRUPTED = 130
EXIT_BROKEN_PIPE = 141

_PLACES = (
    *(errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC, errno.EDQUOT),
    *(errno.EEXIST, errno.EISDIR, errno.ENOTDIR),
)
"""What is wrong with a place for files, and not with the program."""

COMMANDS: dict[str, type[Command]] = {
    "generate": Generate,
    "data": Data,
    "objects": Objects,
    "train": Train,
    "track": Track,
    "monitor": Monitor,
    "eval": Eval,
    "eval-monitor": EvalMonitor,
    "weights": Weights,
    "doctor": Doctor,
}
"""Command line name of every command."""

DESCRIPTION = "Follow handles, knobs, rims and fronts of articulated objects in RGB-D video."


@runtime_checkable
class Command(Protocol):
    """A command's dataclass: its fields are the arguments."""

    def run(self) -> int:
        """Do the work and return the exit code."""
        ...


def parse(arguments: Sequence[str]) -> Command:
    """Parse arguments into a command.

    Args:
        arguments: what follows ``quest`` on the command line.

    Raises:
        SystemExit: on ``--help`` (code 0) and on bad arguments (code 2, after a message on stderr).
    """
    commands: dict[str, Callable[..., Command]] = dict(COMMANDS)
    return tyro.extras.subcommand_cli_from_dict(
        commands,
        prog="quest",
        description=DESCRIPTION,
        args=list(arguments),
        config=(tyro.conf.OmitSubcommandPrefixes, tyro.conf.HelptextFromCommentsOff),
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``quest``.

    Args:
        arguments: what follows ``quest``; those of the process by default.

    Returns:
        The exit code: the command's own, 2 for an error that the user can mend, 130 when interrupted, 141 when nobody
        reads the output any more.
    """
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="backslashreplace")  # names may have letters that the terminal has not
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
    command = parse(arguments or ["--help"])
    try:
        return command.run()
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
    Console(stderr=True, highlight=False).print(f"[bold red]error:[/] [red]{escape(message)}[/]", soft_wrap=True)
    return EXIT_ERROR


if __name__ == "__main__":
    sys.exit(main())
