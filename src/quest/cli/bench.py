"""``quest bench``: trackers on the benchmarks of others."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from quest.cli.evaluate import Lineup, TrackerName, table_console


@dataclass(frozen=True)
class BenchTapvid:
    """Score trackers on videos of TAP-Vid or TAPVid-3D: a table and, with --out, a result file.

    With --out, answers are kept beside it (OUT.parts) until the file is written: run a command that was stopped again
    and it goes on. Layouts, measures, and how to make such videos of takes: docs/metrics.md.
    """

    data: Path
    """Folder with an .npz file for each video; folders in it count too."""
    trackers: tuple[TrackerName, ...] = ("quest", "lk", "hold-still")
    """What to compare; quest eval --help explains them."""
    queries: Literal["first", "strided"] = "first"
    """Ask for every track once, or in every fifth frame that shows it, forwards and backwards."""
    scaling: Literal["median", "per_trajectory", "local_neighborhood", "none"] = "median"
    """How points in space get the scale of the truth."""
    full_size: bool = False
    """Show videos of TAP-Vid as they are, not scaled to 256 x 256; TAP-Vid counts that apart."""
    alone: bool = False
    """Ask for every point in a run of its own, as TAP-Vid wants it where answers depend on other points. Those of quest
    may. Slow."""
    weights: str = "quest-s16"
    """Name or file of the weights of the trackers that need some."""
    rivals: Path | None = None
    """Folder of code and weights of the rivals named -official; docs/metrics.md says what lies there."""
    resamples: int = 1000
    """Of the bootstrap over videos."""
    seed: int = 0
    """Of the bootstrap."""
    out: Path | None = None
    """Result file (.json)."""

    def run(self) -> int:
        """Evaluate, print the tables, write the file.

        Raises:
            ConfigError: settings out of range.
            InputError: there is no video, or one cannot be used.
            WeightsError: the weights cannot be loaded.
        """
        from quest.cli.console import Console
        from quest.cli.progress import counting
        from quest.data.provenance import combined_hash, file_hash
        from quest.errors import ConfigError, InputError
        from quest.evaluation.real.run import KeptAnswers, write_set
        from quest.evaluation.real.table import FULL_WIDTH, real_table
        from quest.evaluation.tapvid.run import COLUMNS, LEGEND, Setting, evaluate_videos

        if not self.trackers or self.resamples < 1 or self.seed < 0 or (self.out and self.out.suffix != ".json"):
            raise ConfigError(
                f"bench tapvid: expected a tracker, resamples >= 1, seed >= 0, --out FILE.json, got {self}"
            )
        start_s, console = time.monotonic(), Console(stderr=True, highlight=False)
        paths = sorted(self.data.rglob("*.npz"))
        files = {path.relative_to(self.data).with_suffix("").as_posix(): path for path in paths}
        if not files:
            raise InputError(f"{self.data}: expected .npz files of TAP-Vid or TAPVid-3D (docs/metrics.md), found none")
        data_hash = combined_hash((name, file_hash(path) or "") for name, path in files.items())
        lineup = Lineup.of(self.trackers, self.weights, self.rivals)
        setting, kept = Setting(self.queries, self.scaling, not self.full_size, self.alone), None
        if self.out is not None:
            made_by = lineup.digest(data_hash, self.queries, self.full_size, self.alone)
            kept = KeptAnswers(self.out.with_suffix(".parts"), made_by=made_by)
        bootstrap = {"resamples": self.resamples, "seed": self.seed}
        with counting(console, "tracking", len(files), "videos") as done:
            rows, single = evaluate_videos(files, lineup.trackers, setting, **bootstrap, kept=kept, progress=done)
        name, output = self.data.resolve().name, table_console(FULL_WIDTH)
        output.print(real_table({name: rows}, width=output.width, shown=COLUMNS, legend=LEGEND))
        if self.out is not None and kept is not None:
            run = lineup.ended(start_s, data_hash=data_hash, **bootstrap)
            write_set(self.out, name, rows, single, run)
            kept.remove()
            console.print(f"wrote {self.out}")
        return 0
