"""Shared by commands that look at takes and objects: a store or one of its takes, tables, pictures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    import numpy as np

    from quest.cli.console import Console
    from quest.data.split import SplitPart
    from quest.data.store import TakeStore
    from quest.errors import TakeError


PICTURES = (".png", ".jpg", ".jpeg", ".webp")


def check_picture(what: str, out: Path) -> None:
    """Raise ConfigError, before anything is read or drawn, unless a file is named like a picture.

    Args:
        what: the command, for the message.
        out: the file.
    """
    from quest.errors import ConfigError

    if out.suffix.lower() not in PICTURES:
        raise ConfigError(f"{what}: --out {out}: expected a picture, {', '.join(PICTURES)}")


def write_picture(sheet: np.ndarray, out: Path) -> None:
    """Write a picture, whole or not at all.

    Args:
        sheet: colours, [H, W, 3] of uint8.
        out: a file named like a picture.

    Raises:
        ConfigError: it is larger than this kind of file may be.
    """
    from PIL import Image

    from quest.errors import ConfigError
    from quest.whole_file import whole_file

    try:
        with whole_file(out) as partial:
            Image.fromarray(sheet).save(partial)
    except (ValueError, OSError) as error:
        if isinstance(error, OSError) and error.errno is not None:
            raise
        size = f"{sheet.shape[1]} x {sheet.shape[0]} px"
        raise ConfigError(f"{out}: {size} are too many for {out.suffix} ({error}); use .png, or draw less") from error


def say_corrupt(stores: Iterable[TakeStore]) -> int:
    """Print on standard error why takes cannot be read and are omitted; returns how many."""
    return sum(say_omitted(problem) for store in stores for problem in store.problems().values())


def no_takes(store: TakeStore, where: str) -> TakeError:
    """The error of a store without a whole take."""
    from quest.errors import TakeError

    torn = "".join(f"; omitted: {problem}" for problem in store.problems().values())
    return TakeError(f"store {where}: no takes; check the path, or generate takes into it{torn}")


def say_omitted(problem: str) -> int:
    """Print on standard error why one take is omitted; returns 1, the number of takes."""
    from quest.cli.console import Console

    Console(stderr=True, highlight=False, markup=False, soft_wrap=True).print(f"omitted: {problem}")
    return 1


def open_takes(where: str) -> tuple[TakeStore, list[str] | None]:
    """A store, and the one take that was named; None where all are meant.

    Args:
        where: folder or URL of a store, or of a take (``STORE/NAME.zarr``).

    Raises:
        TakeError: there is no such store.
    """
    from quest.data.store import locate_take

    if not _is_take(where):
        return open_store(where), None
    store, name = locate_take(where)
    return store, [name]


def open_store(where: str) -> TakeStore:
    """A store of takes.

    Args:
        where: its folder or URL.

    Raises:
        TakeError: there is no such store, or a take is named.
    """
    from quest.data.store import TakeStore, locate_take
    from quest.errors import TakeError

    if _is_take(where):
        store, name = locate_take(where)
        raise TakeError(f"store {where}: expected a store, and this is one take, {name}; name its store, {store.url}")
    store = TakeStore(where)
    if not store.exists():
        raise TakeError(f"store {where}: no such folder; check the path, or make takes with `quest generate`")
    return store


def takes_to_choose_by(
    stores: Iterable[str], *, levels: tuple[int, ...], objects: tuple[str, ...] = ()
) -> list[tuple[TakeStore, dict[str, SplitPart]]]:
    """Takes of validation objects, and of objects in no part of the split, which count as such here, store by store.

    Args:
        stores: their folders or URLs; takes whose description is corrupt are named and omitted.
        levels: to use; all if there are none.
        objects: to use; all if there are none.

    Raises:
        TakeError: there is no such store.
    """
    from quest.evaluation.selection import select_takes

    found = []
    for store in map(open_store, stores):
        say_corrupt([store])
        chosen = select_takes(store.infos(), split=("validation", "unlisted"), levels=levels, objects=objects)
        found.append((store, dict.fromkeys(chosen, "validation")))
    return found


def _is_take(where: str) -> bool:
    return where.rstrip("/\\").endswith(".zarr")


def wide_console() -> Console:
    """For tables: as wide as the terminal; where there is none, wide enough that lines are not broken.

    Brackets are no markup: they may be in the name of a take or an object.
    """
    from quest.cli.console import Console

    console = Console(highlight=False, markup=False)
    return console if console.is_terminal else Console(highlight=False, markup=False, width=180)
