"""What the site needs beside the pages: files of the repository that they link to, and the help of every command."""

from __future__ import annotations

import io
import os
import re
from collections.abc import Iterator
from contextlib import redirect_stdout
from pathlib import Path
from unittest.mock import patch

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
ALWAYS = ("CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md")
COMMANDS_HERE = "<!-- commands -->"
LINK = re.compile(r"(?<=\]\()[^)#\s:]+(?=[)#])")
ROLE = re.compile(r":(?:attr|class|data|exc|func|meth|mod):(?=<code>)")
NOTEBOOK_LINK = re.compile(r'(?<=href=")[^"#:]+\.(?:md|ipynb)(?=[#"])')


def site_uri(path: Path) -> str:
    """Where a file of the repository is in the site: ``docs`` is its top, as the repository's own top is."""
    return path.relative_to(DOCS if path.is_relative_to(DOCS) else ROOT).as_posix()


def linked(page: Path) -> Iterator[Path]:
    """Files of the repository that a page links to."""
    for link in LINK.findall(page.read_text(encoding="utf-8")):
        target = (page.parent / link).resolve()
        if target.is_file() and target.is_relative_to(ROOT):
            yield target


@event_priority(100)  # ahead of the plugin that turns notebooks into pages
def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add what pages link to outside of ``docs``, the notebooks, and the project's own pages."""
    added = {ROOT / name for name in ALWAYS} | set((ROOT / "examples" / "notebooks").glob("*.ipynb"))
    waiting = [*DOCS.rglob("*.md"), *added]
    while waiting:
        page = waiting.pop()
        found = set(linked(page)) - added if page.suffix == ".md" else set()
        added |= {path for path in found if not path.is_relative_to(DOCS)}
        waiting += [path for path in found if not path.is_relative_to(DOCS)]
    for path in sorted(added):
        files.append(File(site_uri(path), str(ROOT), config.site_dir, config.use_directory_urls))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links between folders of the repository into links of the site; put the help of all commands in."""
    here = Path(page.file.abs_src_path or "")

    def moved(link: re.Match[str]) -> str:
        target = (here.parent / link[0]).resolve()
        if not (target.is_file() and target.is_relative_to(ROOT)):
            return link[0]
        return os.path.relpath(site_uri(target), Path(page.file.src_uri).parent)

    if here.suffix == ".md" and here.is_relative_to(ROOT):
        markdown = LINK.sub(moved, markdown)
    return markdown.replace(COMMANDS_HERE, "\n\n".join(sections())) if COMMANDS_HERE in markdown else markdown


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links of notebooks, which are HTML already, into links of the site; leave out roles of docstrings."""
    here = Path(page.file.abs_src_path or "")

    def moved(link: re.Match[str]) -> str:
        target = Path(site_uri((here.parent / link[0]).resolve())).with_suffix(".html")
        return os.path.relpath(target, Path(page.file.src_uri).parent)

    if here.suffix == ".ipynb":
        return NOTEBOOK_LINK.sub(moved, html)
    return ROLE.sub("", html)


def sections() -> Iterator[str]:
    """A heading, and what ``--help`` prints, of every command."""
    from quest.cli.main import COMMANDS, Group

    for name, entry in COMMANDS.items():
        yield f"## quest {name}\n\n{entry.summary}"
        if isinstance(entry, Group):
            for word, inner in entry.commands.items():
                yield f"### quest {name} {word}\n\n{inner.summary}\n\n{help_text(name, word)}"
        else:
            yield help_text(name)


def help_text(*words: str) -> str:
    """What ``quest WORDS --help`` prints, as a block of code."""
    from quest.cli.main import parse

    text = io.StringIO()
    with patch.dict(os.environ, {"COLUMNS": "100", "NO_COLOR": "1", "TERM": "dumb"}), redirect_stdout(text):
        try:
            parse([*words, "--help"])
        except SystemExit as stop:
            if stop.code:
                raise RuntimeError(f"quest {' '.join(words)} --help: exit code {stop.code}") from stop
    plain = re.sub(r"\x1b\[[0-9;]*m", "", text.getvalue())
    return f"```text\n{plain.strip()}\n```"
