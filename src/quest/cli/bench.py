"""``quest bench``: the tables of the publication, and trackers on the benchmarks of others."""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from quest.bench.settings import Making
from quest.cli.console import Console
from quest.cli.evaluate import Lineup, TrackerName
from quest.cli.progress import counting
from quest.cli.takes import table_console
from quest.data.provenance import combined_hash, command_line, file_hash
from quest.errors import ConfigError, InputError
from quest.whole_file import whole_file

if TYPE_CHECKING:
    from collections.abc import Mapping

ALL = "all"
SMOKE: Mapping[str, Any] = {
    "taught": ("procedural:chest-0,cabinet-0",),
    "new": ("procedural:chest-110001",),
    "takes_per_object": 1,
    "levels": (1,),
    "teach_levels": (1,),
    "trackers": ("quest", "hold-still", "lk-grid", "cotracker-retrained"),
    "seeds": (0,),
    "steps": 4,
    "rival_steps": 2,
    "batch": 2,
    "noise": (0.0, 0.05),
    "resamples": 50,
}
"""So small that every table is made in minutes, to see that all of it works."""


@dataclass(frozen=True)
class BenchTable:
    """Make tables of the publication: JSON, Markdown, LaTeX and pictures.

    What they rest on is made as far as it is missing, and kept in --work: simulated takes, trainings of the
    published network, its variants and its rivals, answers of all trackers. Run a command that was stopped again and
    it goes on.
    """

    tables: tyro.conf.Positional[tuple[str, ...]]
    """Tables: comparison, levels, window, slots, losses, remedies, noise, drift, failures, intents, speed, or all."""
    making: Annotated[Making, tyro.conf.arg(name="")] = field(default_factory=Making)
    smoke: bool = False
    """As small as it can be, to try everything in minutes; the figures mean nothing and the files say so."""
    out: Path = Path("outputs/bench")
    """Folder of the tables."""

    def run(self) -> int:
        """Make the tables."""
        from quest.bench.tables import TABLES
        from quest.bench.workbench import Workbench
        from quest.bench.writing import draw, latex, markdown
        from quest.evaluation.report import provenance
        from quest.evaluation.results import write_report

        if unknown := [name for name in self.tables if name not in (*TABLES, ALL)]:
            raise ConfigError(f"bench: no table {unknown[0]!r}; expected some of {', '.join((*TABLES, ALL))}")
        making = self.making
        if self.smoke:
            making = replace(making, **SMOKE, work=making.work / "smoke")
        console, output = Console(stderr=True, soft_wrap=False), table_console(170)
        for name in TABLES if ALL in self.tables else dict.fromkeys(self.tables):
            recipe = TABLES[name]
            found = recipe.make(Workbench(making, console))
            about = {"table": name, "smoke": self.smoke, "making": making.described()}
            report = {**provenance(), "command": command_line(), **about, **found}
            write_report(report, self.out / f"{name}.json")
            plain = json.loads(json.dumps(report, default=asdict))
            said = ["**A trial: these figures mean nothing.**"] * self.smoke
            parts = list(filter(None, (markdown(table, plain, said) for table in recipe.pages)))
            texts = {"md": "\n\n".join(parts) + "\n", "tex": "\n".join(latex(t, plain) for t in recipe.pages)}
            for kind, text in texts.items():
                with whole_file(self.out / f"{name}.{kind}") as partial:
                    partial.write_text(text, encoding="utf-8")
            if recipe.figure is not None:
                rows = [row for row in plain["rows"] if row["reading"] == "moved"]
                draw(recipe.figure, recipe.about, rows, [self.out / f"{name}.{kind}" for kind in ("svg", "png")])
            output.print(texts["md"], soft_wrap=True)
            console.print(f"wrote {self.out / name}.json")
        return 0


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
    """Folder of code and weights of the rivals named -official and of weights those named -retrained; docs/metrics.md
    says what lies there."""
    resamples: int = 1000
    """Of the bootstrap over videos."""
    seed: int = 0
    """Of the bootstrap."""
    out: Path | None = None
    """Result file (.json)."""

    def run(self) -> int:
        """Evaluate, print the tables, write the file."""
        from quest.evaluation.real.run import KeptAnswers, write_set
        from quest.evaluation.real.table import FULL_WIDTH, real_table
        from quest.evaluation.tapvid.run import COLUMNS, LEGEND, Setting, evaluate_videos

        if not self.trackers or self.resamples < 1 or self.seed < 0 or (self.out and self.out.suffix != ".json"):
            raise ConfigError(
                f"bench tapvid: expected a tracker, resamples >= 1, seed >= 0, --out FILE.json, got {self}"
            )
        start_s, console = time.monotonic(), Console(stderr=True, soft_wrap=False)
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
        name, output = self.data.resolve().name, table_console(FULL_WIDTH, markup=True)
        output.print(real_table({name: rows}, width=output.width, shown=COLUMNS, legend=LEGEND))
        if self.out is not None and kept is not None:
            run = lineup.ended(start_s, data_hash=data_hash, **bootstrap)
            write_set(self.out, name, rows, single, run)
            kept.remove()
            console.print(f"wrote {self.out}")
        return 0
