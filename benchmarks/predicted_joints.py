"""Measure how well joints are told from predicted tracks, against the simulator's.

    python benchmarks/predicted_joints.py --takes STORE --split validation \
        --out benchmarks/results/grounding/predicted_joints.json

Every scored entity is asked for as in the protocol point, alarms are off. Moved entities are judged at the first frame
in which their true joint has gone 45 degrees or 15 cm from rest, and at the end of the take. The result file is written
anew after each take, and says until the last one that it is not complete.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from rich import box
from rich.console import Console
from rich.table import Table

import quest
from quest.data.provenance import combined_hash
from quest.data.store import TakeStore
from quest.evaluation.predicted_joints import FAR, JointAnswer, JointRow, joint_rows, judge_view
from quest.evaluation.report import provenance, shown, write_report
from quest.evaluation.selection import select_takes
from quest.grounding import JointKind
from quest.track import Tracker


@dataclass(frozen=True)
class PredictedJoints:
    """Shares of right kinds and axis errors of the tracker's joints."""

    takes: str
    """Folder of the take store."""
    split: tuple[Literal["train", "validation", "test", "unlisted"], ...] = ("validation",)
    """Parts of the object split."""
    level: tuple[int, ...] = ()
    """Levels; all by default."""
    objects: tuple[str, ...] = ()
    """Object ids; all by default."""
    weights: str = "quest-s16"
    """Name or file of the weights."""
    resamples: int = 1000
    """Of the bootstrap over objects."""
    seed: int = 0
    """Of the bootstrap."""
    out: Path | None = None
    """Result file."""

    def run(self) -> int:
        """Track take by take, print, write."""
        store, console = TakeStore(self.takes), Console(width=170, highlight=False)
        chosen = select_takes(store.infos(), split=self.split, levels=self.level, objects=self.objects)
        tracker = quest.load(self.weights)
        about = self._about(tracker, combined_hash((name, store.data_hash(name)) for name in chosen))
        answers: list[JointAnswer] = []
        rows: tuple[JointRow, ...] = ()
        for i, (name, part) in enumerate(chosen.items(), start=1):
            take = store.read(name)
            for view in range(len(take.views)):
                answers += judge_view(tracker, take, view, part=part)
            rows = joint_rows(answers, resamples=self.resamples, seed=self.seed)
            console.print(f"{i}/{len(chosen)} {name}: {len(answers)} answers so far")
            if self.out is not None:
                done = {"takes_done": i, "complete": i == len(chosen), "rows": [asdict(row) for row in rows]}
                write_report(about | done | {"answers": [asdict(a) for a in answers]}, self.out)
        console.print(_table(rows))
        return 0

    def _about(self, tracker: Tracker, data_hash: str) -> dict[str, Any]:
        return provenance() | {
            "weights": self.weights,
            "weights_hash": tracker.weights_hash,
            "data_hash": data_hash,
            "far_deg": float(np.degrees(FAR[JointKind.REVOLUTE])),
            "far_m": FAR[JointKind.PRISMATIC],
            "resamples": self.resamples,
            "seed": self.seed,
        }


def _table(rows: tuple[JointRow, ...]) -> Table:
    table = Table(
        title="joints from predicted tracks",
        box=box.SIMPLE_HEAD,
        caption="95 % bootstrap over objects; axis: median where the kind is right; far: the first frame at 45 degrees "
        "or 15 cm",
    )
    headings = ("objects", "suite", "joint", "when", "objects/takes/answers", "none", "static", "kind right %")
    for heading in (*headings, "axis error, degrees", "p90"):
        table.add_column(heading, justify="left" if heading in headings[:4] else "right")
    for row in rows:
        table.add_row(
            f"{row.source}, {row.part}",
            row.suite,
            row.kind,
            row.moment,
            f"{row.objects}/{row.takes}/{row.answers}",
            str(row.without),
            str(row.static),
            shown(row.kind_right, factor=100, decimals=0),
            shown(row.axis_error_deg, decimals=1),
            "-" if row.axis_p90_deg is None else f"{row.axis_p90_deg:.1f}",
        )
    return table


if __name__ == "__main__":
    raise SystemExit(tyro.cli(PredictedJoints).run())
