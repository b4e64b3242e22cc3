"""The terminal, to which nothing that came with an input gives orders, and the words of a command for it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import MISSING, fields, is_dataclass
from typing import Any, get_type_hints

import rich.console
import tyro
from rich.segment import Segment
from rich.text import Text

_UNSHOWN = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")
"""Control characters, but for the tab and the end of a line."""


class Console(rich.console.Console):
    """As rich's own, for lines of any length; names and words are no markup, and their control characters are shown."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**{"highlight": False, "markup": False, "soft_wrap": True, **options})

    def note(self, text: str) -> None:
        """Say what is less than it could be."""
        self.print(Text.assemble(("note:", "yellow"), f" {text}"))

    def render(
        self, renderable: rich.console.RenderableType, options: rich.console.ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """What is shown, piece by piece."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(shown(segment.text), segment.style)


def shown(text: str) -> str:
    """A text as it may be shown: control characters, which could command the terminal, are written out."""
    return _UNSHOWN.sub(lambda found: f"\\x{ord(found[0]):02x}", text)


def words_of(settings: Any) -> Iterator[str]:
    """The arguments that give a command's dataclass again: what has no default, and what is not as usual."""
    hints = get_type_hints(type(settings), include_extras=True)
    for field in fields(settings):
        about = getattr(hints[field.name], "__metadata__", ())
        named = [each.name for each in about if getattr(each, "name", None)]
        value, flag = getattr(settings, field.name), "--" + (*named, field.name)[0].replace("_", "-")
        default = field.default if field.default_factory is MISSING else field.default_factory()
        if tyro.conf.Positional in about:
            yield str(value)
        elif is_dataclass(value):
            yield from words_of(value)
        elif isinstance(value, bool):
            yield from [] if value == default else [flag if value else flag.replace("--", "--no-", 1)]
        elif value != default and isinstance(value, tuple) and tyro.conf.UseAppendAction not in about:
            yield from [flag, *map(str, value)]
        elif value != default:
            for each in map(str, value if isinstance(value, tuple) else (value,)):
                yield from [f"{flag}={each}"] if each.startswith("-") else [flag, each]
