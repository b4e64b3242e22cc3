"""Words for messages."""

from __future__ import annotations


def counted(number: int, noun: str, plural: str | None = None) -> str:
    """A number and its noun: ``1 frame``, ``2 frames``, ``0 entities``; the plural is with an s by default."""
    return f"{number} {noun if number == 1 else plural or noun + 's'}"
