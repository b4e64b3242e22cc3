"""``quest data``: look at takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class DataShow:
    """Draw a contact sheet of a take: frames of every view with entities, masks and depth."""

    take: Annotated[Path, tyro.conf.Positional]
    """Folder of the take, such as store/take.zarr."""

    out: Path | None = None
    """Picture to write (PNG, JPEG); <take>.png in the current folder by default."""

    columns: int = 8
    """Frames to show, spread evenly from the first to the last."""

    def run(self) -> int:
        """Write the picture and say where it is."""
        from PIL import Image

        from quest.data.store import TakeStore
        from quest.errors import TakeError
        from quest.viz.contact_sheet import contact_sheet

        folder = self.take
        if folder.suffix != ".zarr":
            raise TakeError(f"take {folder}: expected the folder of a take, <store>/<name>.zarr")
        name = folder.name.removesuffix(".zarr")
        sheet = contact_sheet(TakeStore(folder.parent).read(name), columns=self.columns)
        out = self.out or Path(f"{name}.png")
        out.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(sheet).save(out)
        print(f"{out}: {sheet.shape[1]} x {sheet.shape[0]} px, take {name}")
        return 0


@dataclass(frozen=True)
class DataList:
    """List the takes of a store, and what is wrong with those that cannot be read."""

    store: Annotated[Path, tyro.conf.Positional]
    """Folder of takes."""

    verify: bool = False
    """Also read every array and compare with the recorded hash."""

    def run(self) -> int:
        """Print a table; returns 1 if a take is torn or altered."""
        from rich.console import Console
        from rich.table import Table

        from quest.data.store import TakeStore
        from quest.errors import TakeError

        store = TakeStore(self.store)
        if not self.store.is_dir():
            raise TakeError(f"store {self.store}: no such folder; check the path, or generate takes into it")
        table = Table(box=None)
        table.add_column("take", no_wrap=True)
        for title in ("category", "level", "frames", "views", "entities", "data hash"):
            table.add_column(title, overflow="fold")
        headers, problems = store.headers(), store.problems()
        for name, header in headers.items():
            if self.verify:
                try:
                    store.verify(name)
                except TakeError as error:
                    problems[name] = str(error)
            info = header.info
            counts = (info.level, header.frames, len(header.cameras), len(info.entities))
            table.add_row(name, info.category, *map(str, counts), header.data_hash[:12])
        Console(highlight=False).print(table)
        for problem in problems.values():
            Console(stderr=True, highlight=False, markup=False).print(problem, style="red", soft_wrap=True)
        return 1 if problems else 0


@dataclass(frozen=True)
class Data:
    """Look at the data that quest reads and writes."""

    command: Annotated[DataShow, tyro.conf.subcommand("show")] | Annotated[DataList, tyro.conf.subcommand("list")]
    """What to do."""

    def run(self) -> int:
        """Run the chosen command."""
        return self.command.run()
