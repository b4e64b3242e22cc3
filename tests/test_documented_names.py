"""Every name that README and docs give exists: modules, what they hold, fields and methods, commands and options."""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Iterable, Iterator
from contextlib import redirect_stdout
from dataclasses import fields, is_dataclass
from functools import cache
from io import StringIO
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import quest
from tests.test_api_surface import members

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]

OF_VARIABLES = {
    "tracker": "Tracker",
    "stream": "Stream",
    "state": "StreamState",
    "tracks": "Tracks",
    "clip": "Clip",
    "frame": "Frame",
    "camera": "Camera",
    "alarm": "quest.monitor.Alarm",
    "monitor": "quest.monitor.Monitor",
    "verdict": "quest.monitor.Verdict",
    "store": "quest.data.store.TakeStore",
    "take": "quest.types.Take",
    "view": "quest.types.View",
}
"""What a page means by a variable of that name in code: a public name, or the path of a class."""

NO_PATHS = {"quest.camera"}
"""What looks like a path and is none: a key in the description of a LeRobot dataset."""

OF_ALL = {"--help", "--version"}


def of_benchmarks() -> set[str]:
    """Options of the scripts beside the package, which pages name too: their settings' fields."""
    return {
        f"--{name.replace('_', '-')}"
        for path in (ROOT / "benchmarks").glob("*.py")
        for name in re.findall(r"^    ([a-z]\w*): ", path.read_text(encoding="utf-8"), re.MULTILINE)
    }


def code(page: Path) -> list[str]:
    """Code of a page: what stands between back quotes, in blocks, and in indented lines."""
    text = page.read_text(encoding="utf-8")
    blocks = re.findall(r"^```\w*\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    rest = re.sub(r"^```\w*\n.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    return [
        *(line for block in blocks for line in block.splitlines()),
        *re.findall(r"^    (.*)$", rest, re.MULTILINE),
        *re.findall(r"`([^`\n]+)`", rest),
    ]


def resolve(path: str) -> Any:
    """What a dotted path such as ``quest.monitor.Alarm.reason`` leads to.

    Raises:
        AttributeError: it leads nowhere.
    """
    first, *names = path.split(".")
    found: Any = importlib.import_module(first)
    for name in names:
        if is_dataclass(found) and name in {field.name for field in fields(found)}:
            return None  # a field without a default is no attribute of its class
        if isinstance(found, ModuleType) and not hasattr(found, name):
            try:
                found = importlib.import_module(f"{found.__name__}.{name}")
                continue
            except ModuleNotFoundError as error:
                raise AttributeError(path) from error
        found = getattr(found, name)
    return found


def owner(name: str) -> type:
    """The class that a page means."""
    return resolve(name if "." in name else f"quest.{name}")


def named_paths(page: Path) -> Iterator[str]:
    """Dotted paths that begin with ``quest``, and what is imported from there."""
    for line in code(page):
        yield from re.findall(r"(?<![\w./-])quest(?:\.[A-Za-z_]\w*)+(?![\w/])", line)
        imported = re.match(r"from (quest[\w.]*) import ([\w, ]+)", line.strip())
        if imported:
            yield from (f"{imported[1]}.{name.strip()}" for name in imported[2].split(","))


def named_members(page: Path) -> Iterator[tuple[str, str]]:
    """Class and member of ``Tracks.joints`` and ``stream.add(...)``."""
    classes = "|".join(name for name in quest.__all__ if inspect.isclass(getattr(quest, name)))
    variables = "|".join(OF_VARIABLES)
    for line in code(page):
        yield from re.findall(rf"(?<![\w.])({classes})\.([A-Za-z_]\w*)", line)
        if not line.lstrip().startswith(("quest ", "from ", "import ")):
            for variable, member in re.findall(rf"(?<![\w./-])({variables})\.(?!json|mcap|parquet)([a-z_]\w*)", line):
                yield OF_VARIABLES[variable], member


@cache
def options_of(*command: str) -> frozenset[str]:
    """Options that the help of a command names."""
    from quest.cli.main import main

    text = StringIO()
    with redirect_stdout(text), pytest.raises(SystemExit):
        main([*command, "--help"])
    return frozenset(re.findall(r"--[a-z][\w.-]*[\w]", text.getvalue()))


@cache
def commands() -> dict[tuple[str, ...], frozenset[str]]:
    """All commands, ``weights list`` as two words, with their options."""
    from quest.cli.main import COMMANDS, main

    found: dict[tuple[str, ...], frozenset[str]] = {}
    for name in COMMANDS:
        text = StringIO()
        with redirect_stdout(text), pytest.raises(SystemExit):
            main([name, "--help"])
        listed = f"usage: quest {name} COMMAND" in text.getvalue()
        found[(name,)] = options_of(name)
        for word in re.findall(r"^  ([a-z-]+)  ", text.getvalue(), re.MULTILINE) if listed else ():
            found[(name, word)] = options_of(name, word)
    return found


def there(option: str, known: Iterable[str]) -> bool:
    """Whether an option exists; ``--topic-`` and ``--losses.NAME`` stand for all that begin so."""
    return any(other.startswith(option) if option[-1] in ".-" else other == option for other in known)


def test_every_path_leads_somewhere():
    wrong = []
    for page in PAGES:
        for path in sorted(set(named_paths(page)) - NO_PATHS):
            try:
                resolve(path)
            except AttributeError:
                wrong.append(f"{page.name}: {path}")
    assert not wrong


def test_every_member_exists():
    wrong = [
        f"{page.name}: {name}.{member}"
        for page in PAGES
        for name, member in sorted(set(named_members(page)))
        if member not in members(owner(name))
    ]
    assert not wrong


def test_every_command_and_option_exists():
    known, wrong = commands(), []
    anywhere = OF_ALL.union(of_benchmarks(), *known.values())
    for page in PAGES:
        for line in code(page):
            words = line.strip().partition("  #")[0].split()
            named = re.findall(r"(?<!\S)(--[a-z][a-z0-9.-]*)", " ".join(words))
            if words[:1] == ["quest"] and len(words) > 1 and not words[1].startswith("-"):
                name = tuple(words[1:3]) if tuple(words[1:3]) in known else (words[1],)
                options = known.get(name)
                if options is None:
                    wrong.append(f"{page.name}: {line}")
                else:
                    missing = [option for option in named if not there(option, options | OF_ALL)]
                    wrong += [f"{page.name}: quest {' '.join(name)} {option}" for option in missing]
            elif words and words[0].startswith("--"):
                wrong += [f"{page.name}: {option}" for option in named if not there(option, anywhere)]
    assert not wrong


def test_the_rules_notice():
    with pytest.raises(AttributeError):
        resolve("quest.monitor.Alarm.no_such_field")
    with pytest.raises(AttributeError):
        resolve("quest.no_such_module")
    assert resolve("quest.data.recording.read_recording")
    assert "no_such" not in members(quest.Tracks)
    assert {"uv_px", "select"} <= members(quest.Tracks)
    assert ("weights", "list") in commands()
    assert "--out" in commands()[("track",)]
    assert sum(len(list(named_paths(page))) for page in PAGES) > 10
    assert sum(len(list(named_members(page))) for page in PAGES) > 10
