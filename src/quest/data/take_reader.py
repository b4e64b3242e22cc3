"""Views of takes as recordings: their frames, without the ground truth."""

from __future__ import annotations

from pathlib import Path

from quest.data.frame_source import FrameSource, Reader, ReadOptions, source_of_clip
from quest.errors import TakeError
from quest.wording import counted

_SUFFIX = ".zarr"
_NAMED = 8


def _accepts(where: str) -> bool:
    """Takes by their name, there or not; and stores of takes, to say which takes are in them."""
    return where.rstrip("/\\").endswith(_SUFFIX) or "://" in where or any(Path(where).glob(f"*{_SUFFIX}"))


def _open(where: str, options: ReadOptions) -> FrameSource:
    from quest.data.store import TakeStore, open_clip

    if not where.rstrip("/\\").endswith(_SUFFIX):
        raise TakeError(_name_a_take(where, TakeStore(where).names()))
    return source_of_clip(open_clip(where, view=options.view))


def _name_a_take(where: str, names: list[str]) -> str:
    if not names:
        return f"store {where}: expected a take, and this store has none; generate takes into it"
    listed = ", ".join(names[:_NAMED]) + (f" and {len(names) - _NAMED} more" if len(names) > _NAMED else "")
    return (
        f"store {where}: expected a take, and this is a store of {counted(len(names), 'take')} ({listed}); name one, "
        f"such as {where.rstrip('/')}/{names[0]}{_SUFFIX}"
    )


READER = Reader("a take", "STORE/NAME.zarr", _accepts, _open, options=("view",))
