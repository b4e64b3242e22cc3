"""``quest data export``: takes in the formats of others."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from quest.wording import counted

if TYPE_CHECKING:
    from quest.data.store import TakeStore
    from quest.types import Take


@dataclass(frozen=True)
class DataExport:
    """Write takes as TAPVid-3D examples, a LeRobot dataset, or MCAP recordings.

    Exit code 1 if takes of the store cannot be read and were omitted.
    """

    takes: Annotated[str, tyro.conf.Positional]
    """Folder or URL of a store, or of one take (STORE/NAME.zarr)."""

    out: Path
    """Folder to write into: one .npz per view (tapvid3d), one dataset (lerobot), one .mcap per view (mcap)."""

    format: Literal["tapvid3d", "lerobot", "mcap"] = "tapvid3d"
    """Format of the files."""

    def run(self) -> int:
        """Write, and print the files."""
        from quest.cli.takes import open_takes, say_corrupt, say_omitted
        from quest.errors import TakeError

        store, names = open_takes(self.takes)
        chosen = store.names() if names is None else names
        if not chosen:
            raise TakeError(f"store {self.takes}: no takes; check the path, or generate takes into it")
        corrupt = 0 if names is not None else say_corrupt([store])
        if self.format == "lerobot":
            self._write_dataset(store, chosen)
            return 1 if corrupt else 0
        write = _write_tapvid3d if self.format == "tapvid3d" else _write_mcap
        for name in chosen:
            try:
                take = store.read(name)
            except TakeError as error:
                if names is not None:
                    raise
                corrupt += say_omitted(str(error))
                continue
            for path in write(take, self.out):
                print(path)
        return 1 if corrupt else 0

    def _write_dataset(self, store: TakeStore, names: list[str]) -> None:
        """One episode per take, with as many places for joints and entities as the take with the most has."""
        from quest.data.lerobot_export import Episode, export_lerobot
        from quest.types import LABELS

        infos = [store.header(name).info for name in names]
        episodes = export_lerobot(
            (Episode.of_take(store.read(name)) for name in names),
            self.out,
            joints=max(len(info.joints) for info in infos),
            entities=max(sum(entity.label in LABELS for entity in info.entities) for info in infos),
        )
        print(f"{self.out}: {counted(episodes, 'episode')}")


def _write_tapvid3d(take: Take, folder: Path) -> list[Path]:
    from quest.data.export_tapvid3d import export_tapvid3d

    return export_tapvid3d(take, folder)


def _write_mcap(take: Take, folder: Path) -> list[Path]:
    """One file per view, with the true tracks beside the images."""
    from quest.data.lerobot_export import Episode
    from quest.data.mcap_export import export_mcap

    tracks, written = Episode.of_take(take).tracks, []
    for v, view in enumerate(take.views):
        written.append(folder / f"{take.info.name}-v{v}.mcap")
        export_mcap(view.clip, written[-1], tracks=tracks[f"view_{v}"])
    return written
