"""What commands that look at takes and objects share: a store or one of its takes, tables, pictures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    import numpy as np
    from rich.console import Console

    from quest.data.store import TakeStore


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


def say_torn(stores: Iterable[TakeStore]) -> int:
    """Print on standard error what is wrong with takes that cannot be read and are left out; tells how many."""
    return sum(say_left_out(problem) for store in stores for problem in store.problems().values())


def say_left_out(problem: str) -> int:
    """Print on standard error what is wrong with one take; tells that it is one."""
    from rich.console import Console

    Console(stderr=True, highlight=False, markup=False, soft_wrap=True).print(f"left out: {problem}")
    return 1


def open_takes(where: str) -> tuple[TakeStore, list[str] | None]:
    """A store, and the one take that was named; None where all are meant.

    Args:
        where: folder or URL of a store, or of a take (``STORE/NAME.zarr``).

    Raises:
        TakeError: there is no such store.
    """
    from quest.data.store import TakeStore, locate_take
    from quest.errors import TakeError

    if where.rstrip("/\\").endswith(".zarr"):
        store, name = locate_take(where)
        return store, [name]
    store = TakeStore(where)
    if not store.exists():
        raise TakeError(f"store {where}: no such folder; check the path, or generate takes into it")
    return store, None


def wide_console() -> Console:
    """For tables: as wide as the terminal; where there is none, wide enough that lines are not broken.

    What stands in brackets is shown as it is: it may be in the name of a take or an object.
    """
    from rich.console import Console

    console = Console(highlight=False, markup=False)
    return console if console.is_terminal else Console(highlight=False, markup=False, width=180)
