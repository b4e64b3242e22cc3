"""Recordings of other cameras beside the first one of ``quest track``."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from quest.cli.console import Console
from quest.cli.progress import counting

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from quest.cli.source import Source
    from quest.types import Clip, Tracks


def read_others(source: Source, also: tuple[str, ...], console: Console) -> list[Clip]:
    """The clips of ``--also``: paths of recordings, or numbers of views of the take that comes first.

    Raises:
        InputError: a number, but the first is no take.
        RecordingError: no such recording, or it is not as expected.
        TakeError: no such take or view, or it is corrupt.
    """
    from quest.data.recording import open_recording
    from quest.errors import InputError

    clips = []
    for one in also:
        of_take = one.isdigit()
        if of_take and not source.clip.rstrip("/\\").endswith(".zarr"):
            raise InputError(
                f"--also {one}: a number is a view of a take, and {source.clip} is none; give the path of a recording"
            )
        parts = replace(source.parts, view=int(one)) if of_take else None
        other = open_recording(source.clip if of_take else one, parts=parts)
        with counting(console, "reading", other.length) as report:
            clips.append(other.clip(report=report))
        source.say_flags(other, Console(stderr=True, highlight=False, soft_wrap=True))
    return clips


def write_overlays(drawn: list[tuple[Clip, Tracks]], out: Path) -> Iterator[Path]:
    """One video for each view: ``overlay.mp4`` of the first, ``overlay-1.mp4`` of the next, and so on."""
    from quest.viz.overlay import write_overlay

    for v, (clip, tracks) in enumerate(drawn):
        path = out / (f"overlay-{v}.mp4" if v else "overlay.mp4")
        write_overlay(clip, tracks, path)
        yield path
