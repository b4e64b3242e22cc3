"""The terminal, to which nothing that came with an input gives orders."""

from __future__ import annotations

import re
from collections.abc import Iterable

import rich.console
from rich.segment import Segment

_UNSHOWN = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")
"""Control characters, but for the tab and the end of a line."""


class Console(rich.console.Console):
    """As rich's own, but control characters of names and words are written out."""

    def render(
        self, renderable: rich.console.RenderableType, options: rich.console.ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """What is shown, piece by piece."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(shown(segment.text), segment.style)


def shown(text: str) -> str:
    """A text as it may be shown: control characters, which could command the terminal, are written out."""
    return _UNSHOWN.sub(lambda found: f"\\x{ord(found[0]):02x}", text)
