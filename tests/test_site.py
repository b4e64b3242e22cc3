"""The site: every page is in it, nothing is loaded from elsewhere, links lead somewhere; its lists are the code's."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import fields, replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import numpy as np
import pytest
import yaml

import quest
from quest.cli.main import COMMANDS, Group
from quest.filter.joints import Joint, JointKind
from quest.monitor import Alarm
from quest.track.state_lines import state_line
from quest.tracks import COLUMNS, write_joints
from tests.track.test_events import make_state
from tests.viz.test_joint_lines import tracks_of

pytestmark = [pytest.mark.plain, pytest.mark.xdist_group("site")]

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"


def in_navigation(entries: Any) -> Iterator[str]:
    """Pages of a navigation, at any depth."""
    for entry in entries if isinstance(entries, list) else entries.values():
        if isinstance(entry, str):
            yield entry
        else:
            yield from in_navigation(entry)


def listed(page: str, heading: str) -> list[str]:
    """Names in the first column of the tables below a heading."""
    text = (DOCS / page).read_text(encoding="utf-8")
    section = re.split(rf"^#+ {re.escape(heading)}$", text, flags=re.MULTILINE)[1]
    section = re.split(r"^#", section, flags=re.MULTILINE)[0]
    cells = [row.split("|")[1] for row in section.splitlines() if row.startswith("| `")]
    return [name for cell in cells for name in re.findall(r"`(\w+)`", cell)]


def names(of: type) -> list[str]:
    return [field.name for field in fields(of)]


def keys(value: Any) -> set[str]:
    """Keys of all objects in what was JSON."""
    if isinstance(value, dict):
        return set(value).union(*map(keys, value.values()))
    return set().union(*map(keys, value)) if isinstance(value, list) else set()


def test_every_page_is_in_the_navigation():
    pages = set(in_navigation(yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))["nav"]))
    here = {path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")}
    assert here <= pages
    assert not [page for page in pages - here if not (ROOT / page).is_file()]


@pytest.mark.parametrize(
    ("heading", "of"),
    [
        ("Tracks", quest.Tracks),
        ("Joints", quest.Joints),
        ("StreamState", quest.StreamState),
        ("Joint of a stream", Joint),
        ("Alarm", Alarm),
    ],
)
def test_every_field_of_an_answer_is_listed(heading: str, of: type):
    assert sorted(listed("outputs.md", heading)) == sorted(names(of))


def test_every_column_is_listed():
    assert listed("outputs.md", "tracks.parquet") == list(COLUMNS)


def test_every_key_of_joints_json_is_listed(tmp_path: Path):
    write_joints(tracks_of("unknown"), tmp_path / "joints.json")
    written = json.loads((tmp_path / "joints.json").read_text())
    written.pop("units", None)  # its own keys are said in words
    assert keys(written) | {"units"} == set(listed("outputs.md", "joints.json"))


def test_every_key_of_a_json_line_is_listed():
    point = np.zeros(3)
    joint = Joint(JointKind.REVOLUTE, np.array([0.0, 0.0, 1.0]), point, point, 0.0, 1.0, np.eye(4))
    state = replace(make_state(), joint=(joint, None))
    assert keys(json.loads(state_line(state, frame=0))) == set(listed("outputs.md", "JSON lines"))


def test_every_package_has_its_licence_listed():
    page = (DOCS / "licences.md").read_text(encoding="utf-8").lower()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = {name: asked for name, asked in project["optional-dependencies"].items() if name not in ("dev", "docs")}
    for asked in (project["dependencies"], *extras.values()):
        for requirement in asked:
            name = re.split(r"[\[>=<;!~ ]", requirement)[0].lower().replace("_", "-")
            assert f"| {name} |" in page or f"`{name}`" in page, name


class Collector(HTMLParser):
    """What a page loads, links to, and can be linked at."""

    def __init__(self) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.links: list[str] = []
        self.anchors: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Sort an element's addresses."""
        values = {name: value or "" for name, value in attrs}
        self.anchors |= {values[name] for name in ("id", "name") if name in values}
        if tag == "a" and "href" in values:
            self.links.append(values["href"])
        elif tag == "link" and values.get("rel") not in ("canonical", "next", "prev"):
            self.loads.append(values.get("href", ""))
        elif tag != "a" and "src" in values:
            self.loads.append(values["src"])


def read_page(path: Path) -> Collector:
    found = Collector()
    found.feed(path.read_text(encoding="utf-8"))
    return found


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built as `make site` does: a warning is an error (but not with --quiet, which hears none)."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    built = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stdout + built.stderr
    return folder


@pytest.mark.slow
def test_nothing_is_loaded_from_elsewhere(site: Path):
    addresses = [(page.name, address) for page in site.rglob("*.html") for address in read_page(page).loads]
    for sheet in site.rglob("*.css"):
        text = re.sub(r"/\*.*?\*/", "", sheet.read_text(encoding="utf-8"), flags=re.DOTALL)
        addresses += [(sheet.name, address) for address in re.findall(r"url\(['\"]?([^)'\"]+)", text)]
        addresses += [(sheet.name, address) for address in re.findall(r"@import\s+['\"]([^'\"]+)", text)]
    assert len(addresses) > 100
    assert not [(page, address) for page, address in addresses if re.match(r"(https?:)?//", address)]


@pytest.mark.slow
def test_links_inside_lead_somewhere(site: Path):
    pages = {page.resolve(): read_page(page) for page in site.rglob("*.html")}
    dead = []
    for page, found in pages.items():
        for link in [*found.links, *found.loads]:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc or page.name == "404.html":
                continue
            target = (page.parent / unquote(parts.path)).resolve() if parts.path else page
            target = target / "index.html" if target.is_dir() else target
            anchored = not parts.fragment or target not in pages or parts.fragment in pages[target].anchors
            if not target.is_file() or not anchored:
                dead.append((page.name, link))
    assert not dead


@pytest.mark.slow
def test_the_reference_has_every_command_and_name(site: Path):
    commands = (site / "reference" / "cli.html").read_text(encoding="utf-8")
    for name, entry in COMMANDS.items():
        for words in [f"{name} {word}" for word in entry.commands] if isinstance(entry, Group) else [name]:
            assert f"usage: quest {words} " in commands, words
    anchors = read_page(site / "reference" / "api.html").anchors
    for name in set(quest.__all__) - {"LABELS", "QuestError"}:
        assert any(anchor.startswith("quest") and anchor.endswith(f".{name}") for anchor in anchors) or name in (
            "load",
            "read",
        ), name


@pytest.mark.slow
def test_notebooks_are_pages(site: Path):
    for path in (ROOT / "examples" / "notebooks").glob("*.ipynb"):
        assert (site / path.relative_to(ROOT)).with_suffix(".html").is_file(), path
