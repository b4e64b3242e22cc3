"""``quest demo``: track the clips that ship, and say which file to open."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rich.markup import escape

from quest.cli.console import Console


@dataclass(frozen=True)
class Demo:
    """Track the two packaged clips: overlay videos, tables of tracks, and in words what happens."""

    out: Path = Path("outputs/demo")
    """Folder for the first clip; the second gets the same name with -alarm behind it."""

    def run(self) -> int:
        """Track both, and name the videos."""
        from quest.cli.track import Track
        from quest.data.sample import SAMPLES

        console = Console(highlight=False, soft_wrap=True)
        folders = {clip: self.out.with_name(self.out.name + clip.removeprefix(SAMPLES[0])) for clip in SAMPLES}
        for clip, folder in folders.items():
            Track(clip, out=folder).run()
            console.print()
        for folder in folders.values():
            console.print(f"watch [bold]{escape(str(folder / 'overlay.mp4'))}[/]")
        console.print("tracks.parquet beside it has one row per frame and entity. Next: quest track YOUR_VIDEO.mp4")
        return 0
