"""Shared by commands that look at takes and objects: a store or one of its takes, tables, pictures."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from quest.cli.console import Console
from quest.data.split import SplitPart
from quest.data.store import TakeStore, locate_take
from quest.errors import ConfigError, TakeError
from quest.whole_file import whole_file

if TYPE_CHECKING:
    import numpy as np

PICTURES = (".png", ".jpg", ".jpeg", ".webp")


def check_picture(command: str, out: Path) -> None:
    """Raise ConfigError, before anything is read or drawn, unless a file is named like a picture."""
    if out.suffix.lower() not in PICTURES:
        raise ConfigError(f"{command}: --out {out}: expected a picture, {', '.join(PICTURES)}")


def write_picture(sheet: np.ndarray, out: Path, content: str) -> None:
    """Write a picture [H, W, 3] of uint8, whole or not at all, and say where it is and what is on it.

    Raises:
        ConfigError: it is larger than this kind of file may be.
    """
    from PIL import Image

    size = f"{sheet.shape[1]} x {sheet.shape[0]} px"
    try:
        with whole_file(out) as partial:
            Image.fromarray(sheet).save(partial)
    except (ValueError, OSError) as error:
        if isinstance(error, OSError) and error.errno is not None:
            raise
        raise ConfigError(f"{out}: {size} are too many for {out.suffix} ({error}); use .png, or draw less") from error
    print(f"{out}: {size}, {content}")


def say_corrupt(stores: Iterable[TakeStore]) -> int:
    """Print on standard error why takes cannot be read and are omitted; returns how many."""
    return sum(say_omitted(problem) for store in stores for problem in store.problems().values())


def say_omitted(problem: str) -> int:
    """Print on standard error why one take is omitted; returns 1, the number of takes."""
    Console(stderr=True).print(f"omitted: {problem}")
    return 1


def no_takes(store: TakeStore, where: str) -> TakeError:
    """The error of a store without a whole take."""
    torn = "".join(f"; omitted: {problem}" for problem in store.problems().values())
    return TakeError(f"store {where}: no takes; check the path, or generate takes into it{torn}")


def open_takes(where: str) -> tuple[TakeStore, str | None]:
    """A store, and the name of the one take that was meant (``STORE/NAME.zarr``); None where all are.

    Raises:
        TakeError: there is no such store.
    """
    return locate_take(where) if where.rstrip("/\\").endswith(".zarr") else (open_store(where), None)


def open_store(where: str) -> TakeStore:
    """A store of takes in a folder or at a URL.

    Raises:
        TakeError: there is no such store, or a take is named.
    """
    if where.rstrip("/\\").endswith(".zarr"):
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

    All levels and objects are used where none are named; takes whose description is corrupt are named and omitted.

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


def table_console(full_width: int = 180, *, markup: bool = False) -> Console:
    """For tables: as wide as the terminal; a file or pipe has no width of its own and gets every column.

    Where brackets may be in the name of a take or an object, they must be no markup.
    """
    console = Console(markup=markup, soft_wrap=False)
    return console if console.is_terminal else Console(markup=markup, soft_wrap=False, width=full_width)
