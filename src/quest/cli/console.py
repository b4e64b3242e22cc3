"""The terminal, to which nothing that came with an input gives orders."""

from __future__ import annotations

from collections.abc import Iterable

import rich.console
from rich.segment import Segment

from quest.untrusted import shown


class Console(rich.console.Console):
    """As rich's own, but control characters of names and words are written out."""

    def render(
        self, renderable: rich.console.RenderableType, options: rich.console.ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """What is shown, piece by piece."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(shown(segment.text), segment.style)
