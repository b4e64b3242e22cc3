"""``quest track``: follow entities in a recording or a take, into a table of tracks and a video."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro
from rich.console import Console
from rich.markup import escape
from rich.table import Table

if TYPE_CHECKING:
    from quest.types import Clip, Query, Tracks

SAMPLE = "sample"


@dataclass(frozen=True)
class Track:
    """Track a recording or a take; without queries the entities are discovered."""

    clip: tyro.conf.Positional[str]
    """A recording folder, a video, a take (STORE/NAME.zarr), or the word sample for the clip that ships."""
    out: Path | None = None
    """Folder for tracks.parquet and overlay.mp4; default: outputs/CLIP."""
    weights: str = "quest-s16"
    """Name of shipped weights or a file."""
    point: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """An entity by pixel, as FRAME,X,Y or FRAME,X,Y,NAME; give it again for each entity."""
    label: tyro.conf.UseAppendAction[tuple[Literal["handle", "knob", "rim", "front"], ...]] = ()
    """The most confident entity of a label; give it again for more."""
    view: int = 0
    """Which camera of a take."""
    depth: Path | None = None
    """Folder of 16-bit depth images; default: depth beside the colours."""
    camera: Path | None = None
    """Camera file; default: camera.json beside the colours."""
    depth_scale_m: float | None = None
    """Metres per unit of the depth images; default: what the camera file says."""
    device: str = "auto"
    """cpu, cuda, mps or auto."""
    overlay: bool = True
    """Write the video."""

    def run(self) -> int:
        """Track, write, summarise."""
        from quest.data.tracks_file import write_tracks
        from quest.track import load
        from quest.viz.overlay import write_overlay

        console = Console(highlight=False)
        clip = self._read()
        tracker = load(self.weights, device=self.device)
        with console.status(f"tracking {len(clip)} frames on {tracker.device}"):
            tracks = tracker.track(clip, self._queries() or None)
        out = self.out or Path("outputs") / Path(self.clip).stem
        out.mkdir(parents=True, exist_ok=True)
        write_tracks(tracks, out / "tracks.parquet")
        console.print(_summary(clip, tracks))
        for flag in tracks.frame_flags:
            console.print(f"[yellow]note:[/] {escape(flag)}")
        console.print(f"tracks: {escape(str(out / 'tracks.parquet'))}")
        if self.overlay:
            with console.status("drawing"):
                write_overlay(clip, tracks, out / "overlay.mp4")
            console.print(f"video:  {escape(str(out / 'overlay.mp4'))}")
        return 0

    def _read(self) -> Clip:
        from quest.data.recording import read_recording
        from quest.data.sample import sample_folder
        from quest.data.store import open_clip

        if self.clip.rstrip("/").endswith(".zarr"):
            return open_clip(self.clip, view=self.view)
        path = sample_folder() if self.clip == SAMPLE else Path(self.clip)
        return read_recording(path, depth=self.depth, camera=self.camera, depth_scale_m=self.depth_scale_m)

    def _queries(self) -> list[Query]:
        from quest.errors import InputError
        from quest.types import Query

        queries = []
        for text in self.point:
            parts = text.split(",", 3)
            try:
                frame, x, y = int(parts[0]), float(parts[1]), float(parts[2])
            except (ValueError, IndexError) as error:
                raise InputError(
                    f"--point {text!r}: expected FRAME,X,Y or FRAME,X,Y,NAME, such as 0,120.5,88"
                ) from error
            queries.append(Query.point(frame, x, y, name=parts[3] if len(parts) > 3 else ""))
        return queries + [Query.semantic(label) for label in self.label]


def _summary(clip: Clip, tracks: Tracks) -> Table:
    import numpy as np

    table = Table(title=escape(f"{clip.name}: {len(tracks)} frames, {len(tracks.names)} entities"))
    for column in ("entity", "label", "seen", "moved", "confidence", "state at the end"):
        table.add_column(column, justify="left" if column in ("entity", "label") else "right")
    for k, (name, label) in enumerate(zip(tracks.names, tracks.labels, strict=True)):
        points = tracks.point_world[:, k]
        points = points[np.isfinite(points).all(axis=-1)]
        moved = f"{np.linalg.norm(points - points[0], axis=-1).max():.3f} m" if len(points) else "unknown"
        table.add_row(
            escape(name),
            label or "",
            f"{tracks.visible[:, k].mean():.0%}",
            moved,
            f"{tracks.confidence[:, k].mean():.2f}",
            str(tracks.state[-1, k]),
        )
    return table
