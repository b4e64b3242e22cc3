"""What stands at the top of the repository agrees with the package."""

from __future__ import annotations

import re
from pathlib import Path

import quest

ROOT = Path(__file__).parents[1]


def test_the_readme_is_one_page():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 130


def test_the_citation_is_of_this_version():
    text = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.search(rf"^version: {re.escape(quest.__version__)}$", text, re.MULTILINE)
    assert re.search(r"^license: Apache-2\.0$", text, re.MULTILINE)


def test_the_changelog_has_this_version():
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"## {quest.__version__}" in text or "## Unreleased" in text


def test_what_contributors_are_sent_to_is_there():
    """Paths in CONTRIBUTING.md, and names in them that are said to be in a file."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    paths = {path for path in re.findall(r"`((?:src|benchmarks|docs|tests)/[\w/.-]*)`", text) if "NAME" not in path}
    assert len(paths) > 10
    assert [path for path in sorted(paths) if not (ROOT / path).exists()] == []


def test_cards_say_their_data_in_a_few_lines():
    for card in (ROOT / "src" / "quest" / "assets" / "weights").glob("*.md"):
        data = card.read_text(encoding="utf-8").partition("\n## Data\n")[2].partition("\n## ")[0]
        assert 5 < len(data.strip().splitlines()) <= 25, card
