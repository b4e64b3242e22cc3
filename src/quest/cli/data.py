"""``quest data``: look at takes, check them, and hand them to others."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from quest.wording import counted

if TYPE_CHECKING:
    import numpy as np

    from quest.data.store import TakeStore

MOST_FRAMES_SHOWN = 600


@dataclass(frozen=True)
class DataShow:
    """Look at a take, or at several of a store: a contact sheet, or a Rerun recording."""

    takes: Annotated[str, tyro.conf.Positional]
    """Folder or URL of a take (STORE/NAME.zarr), or of a store."""

    out: Path | None = None
    """Picture to write (PNG, JPEG, WebP); default: NAME.png in the current folder, unless Rerun is asked for."""

    columns: int = 8
    """Frames on the sheet, spread evenly: of one take from the first to the last, of several from the first on."""

    rows: int = 12
    """Takes on the sheet of a store, spread evenly over their names."""

    rrd: Path | None = None
    """Save a Rerun recording: images, depth as points, entities and trails, joint axes, cameras, masks, curves."""

    rerun: bool = False
    """Open Rerun's viewer."""

    every: int | None = None
    """Of a take, show every n-th frame only; default: 1, more for takes of more than 600 frames."""

    def run(self) -> int:
        """Write the picture or the recording and say where it is."""
        from quest.cli.takes import check_picture, open_takes
        from quest.errors import ConfigError, TakeError

        if (self.every is not None and self.every < 1) or self.rows < 1 or self.columns < 1:
            raise ConfigError("show: expected --every, --rows and --columns of at least 1")
        if self.out is not None:
            check_picture("show", self.out)
        store, names = open_takes(self.takes)
        if names is not None:
            return self._show_take(store, names[0])
        if self.rrd is not None or self.rerun or self.every is not None:
            example = next(iter(store.names()), "NAME")
            raise TakeError(
                f"show: --rrd, --rerun and --every are for one take, and {self.takes} is a store; name one, such as "
                f"{self.takes.rstrip('/')}/{example}.zarr"
            )
        return self._show_store(store)

    def _show_take(self, store: TakeStore, name: str) -> int:
        every = self.every or -(-store.header(name).frames // MOST_FRAMES_SHOWN)
        take = store.read(name, frames=slice(None, None, every))
        if self.rrd is not None or self.rerun:
            from quest.viz.rerun_log import open_viewer, save_rrd

            if self.rrd is not None:
                save_rrd(take, self.rrd, every=every)
                megabytes = self.rrd.stat().st_size / 1e6
                print(f"{self.rrd}: {megabytes:.1f} MB, take {name}; open it with: rerun {self.rrd}")
            if self.rerun:
                open_viewer(take, every=every)
        if self.out is not None or not (self.rrd or self.rerun):
            from quest.viz.contact_sheet import contact_sheet

            sheet = contact_sheet(take, columns=self.columns, every=every)
            self._write(sheet, self.out or Path(f"{name}.png"), f"take {name}")
        return 0

    def _show_store(self, store: TakeStore) -> int:
        from quest.errors import TakeError
        from quest.viz.contact_sheet import takes_sheet

        headers = store.headers()
        if not headers:
            raise TakeError(f"store {self.takes}: no takes; check the path, or generate takes into it")
        names = list(headers)
        picked = sorted({round(i * (len(names) - 1) / max(self.rows - 1, 1)) for i in range(self.rows)})
        takes = []
        for name in (names[i] for i in picked):
            step = max(1, (headers[name].frames - 1) // max(self.columns - 1, 1))
            takes.append(store.read(name, views=[0], frames=slice(None, None, step)))
        title = f"{self.takes}: {len(takes)} of {len(names)} takes"
        where = str(store.root.resolve()) if store.is_folder else self.takes
        name = where.rstrip("/\\").replace("\\", "/").rpartition("/")[2] or "takes"
        sheet = takes_sheet(takes, title=title, columns=self.columns)
        self._write(sheet, self.out or Path(f"{name}.png"), counted(len(takes), "take"))
        return 0

    @staticmethod
    def _write(sheet: np.ndarray, out: Path, what: str) -> None:
        from quest.cli.takes import write_picture

        write_picture(sheet, out)
        print(f"{out}: {sheet.shape[1]} x {sheet.shape[0]} px, {what}")


@dataclass(frozen=True)
class DataLs:
    """List the takes of a store, and the faults of those that cannot be read."""

    store: Annotated[str, tyro.conf.Positional]
    """Folder or URL of takes."""

    def run(self) -> int:
        """Print a table; returns 1 if a take is corrupt."""
        from rich.console import Console
        from rich.table import Table

        from quest.cli.takes import open_takes, wide_console

        store, names = open_takes(self.store)
        table = Table(box=None)
        table.add_column("take", no_wrap=True)
        for title in ("suite", "category", "level", "frames", "views", "entities", "MB", "data hash"):
            right = title in ("level", "frames", "views", "entities", "MB")
            table.add_column(title, overflow="fold", justify="right" if right else "left")
        headers = {name: header for name, header in store.headers().items() if names is None or name in names}
        problems = {name: text for name, text in store.problems().items() if names is None or name in names}
        for name, header in headers.items():
            info = header.info
            counts = map(str, (info.level, header.frames, len(header.cameras), len(info.entities)))
            megabytes = f"{sum(header.files.values()) / 1e6:.1f}"
            table.add_row(name, info.suite, info.category, *counts, megabytes, header.data_hash[:12])
        for name in names or ():
            if name not in headers and name not in problems:
                store.header(name)  # says that there is none
        console = wide_console()
        console.print(table)
        frames = sum(header.frames * len(header.cameras) for header in headers.values())
        console.print(f"{counted(len(headers), 'take')}, {counted(frames, 'frame')}", style="dim")
        for problem in problems.values():
            Console(stderr=True, highlight=False, markup=False).print(problem, style="red", soft_wrap=True)
        return 1 if problems else 0
