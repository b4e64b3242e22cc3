"""``quest track``: follow entities in a recording or a take, into a table of tracks and a video."""

from __future__ import annotations

import re
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rich.markup import escape
from rich.table import Table

from quest.cli.console import Console
from quest.cli.progress import counting
from quest.cli.source import Source
from quest.wording import counted

if TYPE_CHECKING:
    from quest.types import Clip, Tracks


@dataclass(frozen=True)
class Track(Source):
    """Track a recording or a take; without queries the entities are discovered."""

    out: Path | None = None
    """Folder for tracks.parquet, joints.json and overlay.mp4; default: outputs/NAME, for a take with the view."""
    overlay: bool = True
    """Write the video."""
    rrd: Path | None = None
    """Also save a Rerun recording: frames, depth as points, tracks in the image and in space, joints."""
    rerun: bool = False
    """Open Rerun's viewer on the tracks."""

    def run(self) -> int:
        """Track, write, summarise."""
        self.check_alpha()
        console = Console(highlight=False, soft_wrap=True)
        console.print(f"reading {escape(self.clip)}")  # at once: the imports that follow take a while
        from quest.viz.narrate import narrate
        from quest.viz.overlay import write_overlay
        from quest.viz.rerun_tracks import check_viewer, open_tracks, save_tracks

        if self.rrd is not None or self.rerun:
            check_viewer(on_screen=self.rerun)
        clip = self.read(console)
        queries = self.queries(clip)
        console.print(f"loading weights {escape(self.weights)}")
        tracker = self.tracker()
        out = self._make_folder(clip)
        depth = "" if clip.depth_m is None else " with depth"
        size = f"{clip.camera.width} x {clip.camera.height}"
        console.print(f"tracking {counted(len(clip), 'frame')} of {size}{depth} on {tracker.device}")
        with counting(console, "tracking", len(clip)) as report:
            tracks = tracker.track(
                clip, queries, online=self.online, alpha=self.alpha, alpha_frames=self.alpha_frames, report=report
            )
        tracks.save(out)
        console.print(_summary(clip, tracks))
        console.print("\n".join(map(escape, narrate(tracks))))
        self.say_shortfall(tracker, console, frames=len(clip), inputs="colours" if clip.depth_m is None else "depth")
        for flag in tracks.frame_flags[len(clip.notes) :]:  # those of the clip were said when it was read
            console.print(f"[yellow]note:[/] {escape(flag)}")
        console.print(f"tracks: {escape(str(out / 'tracks.parquet'))}")
        if tracks.joints is not None:
            console.print(f"joints: {escape(str(out / 'joints.json'))}")
        if self.overlay:
            with console.status("drawing"):
                write_overlay(clip, tracks, out / "overlay.mp4")
            console.print(f"video:  {escape(str(out / 'overlay.mp4'))}")
        if self.rrd is not None:
            save_tracks(clip, tracks, self.rrd)
            console.print(f"rerun:  {escape(str(self.rrd))}; open it with: rerun {escape(str(self.rrd))}")
        if self.rerun:
            open_tracks(clip, tracks)
        return 0

    def _make_folder(self, clip: Clip) -> Path:
        """The folder to write to, which is tried before the work."""
        from quest.errors import InputError

        out = self.out or Path("outputs") / self._name(clip)
        try:
            out.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=out).close()
        except OSError as error:
            raise InputError(
                f"--out {out}: cannot be made a folder, or not be written to ({error.strerror}); name another"
            ) from error
        return out

    def _name(self, clip: Clip) -> str:
        """Name of the folder of a clip: views of a take, and episodes of a dataset, have folders of their own."""
        take = self.clip.rstrip("/\\")
        name = f"{Path(take).stem}-view{self.parts.view}" if take.endswith(".zarr") else clip.name
        return re.sub(r'[/\\:*?"<>|\x00-\x1f\ud800-\udfff]', "-", name).strip(". ") or "clip"


def _summary(clip: Clip, tracks: Tracks) -> Table:
    import numpy as np

    from quest.types import State

    table = Table(
        title=escape(
            f"{clip.name}: {counted(len(tracks), 'frame')}, {counted(len(tracks.names), 'entity', 'entities')}"
        ),
        box=None,
        pad_edge=False,
        padding=(0, 2, 0, 0),
        header_style="dim",
        title_justify="left",
    )
    for column in ("entity", "label", "seen", "moved", "joint", "conf.", "at the end"):
        left = column in ("entity", "label", "joint")
        table.add_column(column, justify="left" if left else "right", no_wrap=column == "joint")
    for k, (name, label) in enumerate(zip(tracks.names, tracks.labels, strict=True)):
        bound = np.isfinite(tracks.uv_px[:, k]).all(axis=-1)  # from the frame on in which it was asked for and found
        if not bound.any():
            table.add_row(escape(name), label or "", "", "", "", "", "not found")
            continue
        points = tracks.point_world[:, k]
        points = points[np.isfinite(points).all(axis=-1) & (tracks.state[:, k] != State.LOST)]
        moved = f"{np.linalg.norm(points - points[0], axis=-1).max():.3f} m" if len(points) else "unknown"
        joint = "unknown" if tracks.joints is None else tracks.joints.describe(k)
        seen, sure = tracks.visible[bound, k].mean(), tracks.confidence[bound, k].mean()
        table.add_row(escape(name), label or "", f"{seen:.0%}", moved, joint, f"{sure:.2f}", str(tracks.state[-1, k]))
    return table
