"""``quest track``: follow entities in a recording or a take, into a table of tracks and a video; ``quest demo``."""

from __future__ import annotations

import re
import shlex
import tempfile
import time
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tyro
from rich.table import Table
from rich.text import Text

from quest.cli.console import Console, words_of
from quest.cli.progress import counting
from quest.cli.source import Source, read_saying, say_shortfall
from quest.data.sample import SAMPLES
from quest.errors import InputError
from quest.viz.narrate import narrate, summarise
from quest.wording import counted

if TYPE_CHECKING:
    from collections.abc import Callable

    from quest.track import Tracker
    from quest.types import Clip, Query, Tracks


@dataclass(frozen=True)
class Track(Source):
    """Track a recording or a take; without queries the entities are discovered."""

    also: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Another camera that saw the same at the same time, whose tracks are fused with these: the path of its recording,
    or, of a take, the number of a view; give it again for each camera. Queries are asked in the first one."""
    out: Path | None = None
    """Folder for tracks.parquet, joints.json, run.json and overlay.mp4; default: outputs/NAME, for a take with the
    view."""
    overlay: bool = True
    """Write the video."""
    urdf: Path | None = None
    """Also write the joints as a URDF, which planners and simulators load."""
    rrd: Path | None = None
    """Also save a Rerun recording: frames, depth as points, tracks in the image and in space, joints."""
    rerun: bool = False
    """Open Rerun's viewer on the tracks."""

    def run(self) -> int:
        """Track, write, summarise."""
        self.check_alpha()
        console = Console()
        console.print(f"reading {self.clip}")  # at once: the imports that follow take a while
        from quest.data.urdf_export import write_urdf
        from quest.viz.rerun_log import check_viewer, save_tracks

        if self.rrd is not None or self.rerun:
            check_viewer(on_screen=self.rerun)
        clip = self.read(console)
        others = self._read_others(console)
        queries = self.queries(clip)
        console.print(f"loading weights {self.weights}")
        tracker = self.tracker()
        out = self._make_folder(clip)
        depth = "" if clip.depth_m is None else " with depth"
        size = f"{clip.camera.width} x {clip.camera.height}"
        console.print(f"tracking {counted(len(clip), 'frame')} of {size}{depth} on {tracker.device}")
        began_s = time.monotonic()
        with counting(console, "tracking", len(clip)) as report:
            tracks, drawn = self._track(tracker, [clip, *others], queries, report)
        took_s = time.monotonic() - began_s
        tracks.save(out)
        self._record(out, clip, queries, tracker, took_s)
        console.print(_summary(clip, tracks))
        console.print("\n".join(narrate(tracks)))
        brings = "colours" if clip.depth_m is None else "depth"
        say_shortfall(tracker, console, self.budget(tracker), frames=len(clip), inputs=brings)
        for flag in tracks.frame_flags[len(clip.notes) :]:  # those of the clip were said when it was read
            console.note(flag)
        console.print(f"tracks: {out / 'tracks.parquet'}")
        if tracks.joints is not None:
            console.print(f"joints: {out / 'joints.json'}")
        if self.overlay:
            self._write_overlays(drawn, out, console)
        if self.urdf is not None:
            names = write_urdf(tracks, self.urdf)
            console.print(f"urdf:   {self.urdf}")
            if names.left_out:
                console.note(f"{self.urdf} lacks what has no known joint: {', '.join(names.left_out)}")
        if self.rrd is not None:
            save_tracks(clip, tracks, self.rrd)
            console.print(f"rerun:  {self.rrd}; open it with: rerun {self.rrd}")
        if self.rerun:
            save_tracks(clip, tracks, None)
        return 0

    def _read_others(self, console: Console) -> list[Clip]:
        """The clips of ``--also``."""
        from quest.data.recording import open_recording

        clips = []
        for one in self.also:
            of_take = one.isdigit()
            if of_take and not self.clip.rstrip("/\\").endswith(".zarr"):
                raise InputError(
                    f"--also {one}: a number is a view of a take, and {self.clip} is none; give the path of a recording"
                )
            parts = replace(self.parts, view=int(one)) if of_take else None
            other = open_recording(self.clip if of_take else one, parts=parts)
            clips.append(read_saying(other, console))
        return clips

    def _write_overlays(self, drawn: list[tuple[Clip, Tracks]], out: Path, console: Console) -> None:
        """One video for each view: ``overlay.mp4`` of the first, ``overlay-1.mp4`` of the next, and so on."""
        from quest.viz.overlay import write_overlay

        videos = [out / (f"overlay-{v}.mp4" if v else "overlay.mp4") for v in range(len(drawn))]
        with console.status("drawing"):
            for (clip, tracks), path in zip(drawn, videos, strict=True):
                write_overlay(clip, tracks, path)
        console.print("\n".join(f"video:  {path}" for path in videos))

    def _track(
        self, tracker: Tracker, clips: list[Clip], queries: list[Query] | None, report: Callable[[int], object]
    ) -> tuple[Tracks, list[tuple[Clip, Tracks]]]:
        """The tracks, and the same as each clip sees them."""
        from quest.track.views import track_views

        budget = {"alpha": self.alpha, "alpha_frames": self.alpha_frames}
        if len(clips) == 1:
            tracks = tracker.track(clips[0], queries, online=self.online, **budget, report=report)
            return tracks, [(clips[0], tracks)]
        fused = track_views(tracker, clips, queries, online=self.online, **budget, report=report)
        return fused.whole, [(clip, fused.seen_from(v, clip)) for v, clip in enumerate(clips)]

    @property
    def command(self) -> str:
        """The command that does the same again, in a shell's words."""
        return shlex.join(["quest", "track", *words_of(self)])

    def _record(self, out: Path, clip: Clip, queries: list[Query] | None, tracker: Tracker, took_s: float) -> None:
        """Write how the run was made, for `quest report` and for whoever finds the folder."""
        from quest import __version__
        from quest.viz.report import Recorded, RunRecord, write_run

        view, frames, has_depth = self.parts.view, len(clip), clip.depth_m is not None
        run = RunRecord(
            quest=__version__,
            date=datetime.now().astimezone().isoformat(timespec="seconds"),
            command=self.command,
            recording=Recorded(self.clip, view, clip.name, frames, clip.camera, has_depth, clip.notes),
            weights=self.weights,
            weights_hash=tracker.weights_hash,
            alpha=self.alpha,
            alpha_frames=self.alpha_frames,
            device=str(tracker.device),
            queries=None if queries is None else tuple(queries),
            overlay=self.overlay,
            took_s=round(took_s, 3),
        )
        write_run(run, out)

    def _make_folder(self, clip: Clip) -> Path:
        """The folder to write to, which is tried before the work."""
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


@dataclass(frozen=True)
class Demo:
    """Track the two packaged clips: overlay videos, tables of tracks, and in words what happens."""

    out: Path = Path("outputs/demo")
    """Folder for the first clip; the second gets the same name with -alarm behind it."""

    def run(self) -> int:
        """Track both, and name the videos."""
        console = Console()
        folders = {clip: self.out.with_name(self.out.name + clip.removeprefix(SAMPLES[0])) for clip in SAMPLES}
        for clip, folder in folders.items():
            Track(clip, out=folder).run()
            console.print()
        for folder in folders.values():
            console.print(Text.assemble("watch ", (str(folder / "overlay.mp4"), "bold")))
        console.print("tracks.parquet beside it has one row per frame and entity. Next: quest track YOUR_VIDEO.mp4")
        return 0


def _summary(clip: Clip, tracks: Tracks) -> Table:
    title = f"{clip.name}: {counted(len(tracks), 'frame')}, {counted(len(tracks.names), 'entity', 'entities')}"
    style: dict[str, Any] = {"padding": (0, 2, 0, 0), "header_style": "dim", "title_justify": "left"}
    table = Table(title=title, box=None, pad_edge=False, **style)
    for column in ("entity", "label", "seen", "moved", "joint", "conf.", "at the end"):
        left = column in ("entity", "label", "joint")
        table.add_column(column, justify="left" if left else "right", no_wrap=column == "joint")
    for k, row in enumerate(summarise(tracks, [])):
        bound = np.isfinite(tracks.uv_px[:, k]).all(axis=-1)  # from the frame on in which it was asked for and found
        sure = f"{tracks.confidence[bound, k].mean():.2f}" if bound.any() else ""
        table.add_row(row.name, row.label, row.seen, row.moved, row.joint, sure, row.end)
    return table
