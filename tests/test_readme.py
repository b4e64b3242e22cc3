"""The README is run as written: its Python block, its commands as far as their arguments."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
PAGES = [README, *sorted(ROOT.glob("C*.md")), *sorted((ROOT / "docs").rglob("*.md"))]


def blocks(path: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", path.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


def commands() -> list[tuple[str, str]]:
    """Page and line of every `quest ...` command that the pages show in a block."""
    found = []
    for page in PAGES:
        lines = [line for block in blocks(page, "sh") for line in block.splitlines()]
        lines += re.findall(r"^    (quest .*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
        found += [(page.name, line.strip()) for line in lines if line.startswith("quest ")]
    return found


@pytest.mark.parametrize(("page", "command"), commands())
def test_commands_parse(page, command):
    from quest.cli.main import parse

    parse(shlex.split(command, comments=True)[1:])


def test_there_are_commands_to_check():
    assert {page for page, _ in commands()} >= {"README.md", "takes.md"}


def test_make_targets_exist():
    makefile = (ROOT / "Makefile").read_text()
    text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    assert {"demo", "test"} <= set(re.findall(r"\bmake ([a-z-]+)\b", text))
    for target in set(re.findall(r"(?:`|^)make ([a-z-]+)", text, re.MULTILINE)):
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target


def test_links_lead_somewhere():
    dead = [
        f"{page.name}: {link}"
        for page in PAGES
        for link in re.findall(r"\]\(([^)#:]+)\)", page.read_text(encoding="utf-8"))
        if not (page.parent / link).exists()
    ]
    assert not dead


@pytest.mark.slow
def test_python_example_runs(monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    shared: dict = {}
    for block in blocks(README, "python"):
        exec(compile(block, "<example of the README>", "exec"), shared)
    assert "knob" in capsys.readouterr().out
