"""``quest eval``: track takes of a store under the protocols and print what came of it."""

from __future__ import annotations

import time
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rich.console import Console

    from quest.data.store import TakeStore
    from quest.evaluation.finished import FinishedTakes
    from quest.evaluation.protocols import ClipTracker
    from quest.evaluation.results import Results, Run
    from quest.evaluation.runner import Evaluated
    from quest.evaluation.selection import Shard, SplitPart

TrackerName = Literal[
    "quest",
    "quest-ungrounded",
    "quest-pixels",
    "redetect",
    "redetect-1",
    "flow-chain",
    "flow-chain-0.01",
    "flow-chain-0.02",
    "flow-chain-0.05",
    "lk",
    "hold-still",
]


@dataclass(frozen=True)
class Eval:
    """Evaluate trackers on takes: a table in the terminal and, with --out, a result file.

    With --out, takes are kept beside it as they are done (OUT.parts) until the file is written: run a command that was
    stopped again and it goes on, or run it in several processes with --shard.

    The protocol point always has the tracker hold-still for comparison; lk and hold-still do not have the protocol
    semantic.

    Attributes:
        takes: folder of the take store.
        protocol: point (the true pixel is given) and semantic (nothing is given).
        trackers: what to compare; quest-ungrounded is quest without joints, quest-pixels without depth, redetect and
            flow-chain its network without queries or anchors (docs/metrics.md).
        weights: name or file of the weights of all trackers but lk and hold-still.
        split: parts of the object split; training objects are reported only if train is named here.
        level: levels to evaluate; all by default.
        objects: object ids to evaluate; all by default.
        same_objects: keep only objects that have takes of every level, so that levels compare.
        resamples: of the bootstrap over objects.
        seed: of the bootstrap and of the noise of chained flow.
        shard: part of the takes, such as 0/2 and 1/2 for two processes side by side; the last one reports. Needs --out.
        out: result file (.json); the per-frame records go beside it (.records.parquet).
    """

    takes: str
    protocol: tuple[Literal["point", "semantic"], ...] = ("point",)
    trackers: tuple[TrackerName, ...] = ("quest", "lk", "hold-still")
    weights: str = "quest-s16"
    split: tuple[Literal["train", "validation", "test", "unlisted"], ...] = ("validation", "test", "unlisted")
    level: tuple[int, ...] = ()
    objects: tuple[str, ...] = ()
    same_objects: bool = False
    resamples: int = 1000
    seed: int = 0
    shard: str = "0/1"
    out: Path | None = None

    def run(self) -> int:
        """Evaluate, print the table, write the file.

        Raises:
            ConfigError: nothing to evaluate, or settings out of range.
            TakeError: the store is missing or a take is torn.
            WeightsError: the weights cannot be loaded.
        """
        from rich.console import Console

        from quest.errors import ConfigError
        from quest.evaluation.results import write_results
        from quest.evaluation.selection import Shard, select_takes
        from quest.evaluation.tables import FULL_WIDTH, results_table

        if not self.protocol or not self.trackers or self.resamples < 1 or self.seed < 0:
            raise ConfigError(
                f"eval: expected a protocol, a tracker, resamples >= 1 and seed >= 0, got {self.protocol}, "
                f"{self.trackers}, {self.resamples}, {self.seed}"
            )
        if self.out is not None and self.out.suffix != ".json":
            raise ConfigError(f"eval: expected --out to end in .json, got {self.out}")
        shard = Shard.parse(self.shard)
        if self.out is None and shard.count > 1:
            raise ConfigError(f"eval: --shard {self.shard} needs --out, beside which the processes share what is done")
        start_s = time.monotonic()
        store, broken = self._open_store()
        chosen = select_takes(
            store.infos(), split=self.split, levels=self.level, objects=self.objects, same_objects=self.same_objects
        )
        trackers = self._load_trackers(store)
        console = Console(stderr=True)
        finished = self._finished(trackers)
        found = self._evaluate(store, chosen, trackers, finished, shard, console)
        if found.missing:
            console.print(f"{found.missing} takes are left to other shards; nothing is reported yet")
            return 0
        results = self._results(found, broken, self._run(store, chosen, trackers, start_s))
        output = Console()
        if not output.is_terminal:  # a file or pipe has no width of its own: show every column
            output = Console(width=FULL_WIDTH)
        output.print(results_table(results, width=output.width))
        if self.out is not None:
            write_results(results, self.out, records=found.records)
            console.print(f"wrote {self.out}", highlight=False)
        if finished is not None:
            finished.remove()
        return 0

    def _finished(self, trackers: list[ClipTracker]) -> FinishedTakes | None:
        """Where takes are kept while the evaluation runs; nowhere without --out."""
        import hashlib

        from quest.data.provenance import code_hash, package_versions
        from quest.evaluation.finished import FinishedTakes

        if self.out is None:
            return None
        answers = [code_hash(), package_versions(), self.protocol, [t.name for t in trackers], self.seed]
        digest = hashlib.sha256(repr([*answers, self.weights, self._weights_hash(trackers)]).encode())
        return FinishedTakes(self.out.with_suffix(".parts"), made_by=digest.hexdigest())

    def _weights_hash(self, trackers: list[ClipTracker]) -> str | None:
        from quest.data.provenance import file_hash

        return next((h for t in trackers if (h := getattr(t, "weights_hash", None))), None) or file_hash(self.weights)

    def _open_store(self) -> tuple[TakeStore, list[str]]:
        """The store, and the names of its torn takes."""
        from quest.data.store import TakeStore
        from quest.errors import TakeError

        store = TakeStore(self.takes)
        if not store.exists():
            raise TakeError(
                f"take store {self.takes}: expected a store of takes, found none; make one with quest generate"
            )
        return store, sorted(store.problems())

    def _load_trackers(self, store: TakeStore) -> list[ClipTracker]:
        from quest.evaluation.lineup import line_up, units_of

        names: list[str] = list(self.trackers)
        if "point" in self.protocol:
            names.append("hold-still")
        return list(line_up(names, weights=self.weights, unit_m=units_of([store]), seed=self.seed))

    def _evaluate(
        self,
        store: TakeStore,
        chosen: Mapping[str, SplitPart],
        trackers: list[ClipTracker],
        finished: FinishedTakes | None,
        shard: Shard,
        console: Console,
    ) -> Evaluated:
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            Progress,
            TextColumn,
            TimeElapsedColumn,
            TimeRemainingColumn,
        )

        from quest.evaluation.runner import evaluate, has_protocol

        runs = sum(has_protocol(t, p) for t in trackers for p in self.protocol)
        headers = store.headers()
        own = [headers[name] for i, name in enumerate(chosen) if i in shard]
        frames = sum(header.frames * len(header.cameras) for header in own) * runs
        bar = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        with Progress(*bar, console=console, transient=True) as progress:
            task = progress.add_task("frames", total=frames)

            def advance(doing: str, done: int) -> None:
                progress.update(task, description=doing, advance=done)

            return evaluate(
                store,
                chosen,
                trackers,
                protocols=self.protocol,
                finished=finished,
                shard=shard,
                progress=advance,
            )

    def _run(
        self, store: TakeStore, chosen: Mapping[str, SplitPart], trackers: list[ClipTracker], start_s: float
    ) -> Run:
        from quest.data.provenance import code_commit, combined_hash, command_line, machine, package_versions
        from quest.evaluation.results import Run

        with_quest = any(name not in ("lk", "hold-still") for name in self.trackers)
        return Run(
            command=command_line(),
            commit=code_commit(),
            data_hash=combined_hash((name, store.data_hash(name)) for name in chosen),
            weights=self.weights if with_quest else None,
            weights_hash=self._weights_hash(trackers) if with_quest else None,
            resamples=self.resamples,
            seed=self.seed,
            machine=machine(),
            versions=package_versions(),
            stamp=datetime.now(UTC).isoformat(timespec="seconds"),
            seconds=round(time.monotonic() - start_s, 1),
        )

    def _results(self, found: Evaluated, broken: list[str], run: Run) -> Results:
        from quest.evaluation.results import Results
        from quest.evaluation.summary import summarise

        rows = summarise(found.records, found.discoveries, resamples=self.resamples, seed=self.seed)
        notes = list(found.notes)
        if broken:
            notes.append(f"torn takes of the store were left out: {', '.join(broken)}")
        levels: dict[tuple[str, str], dict[int, set[str]]] = {}
        for record in found.records:
            s = record.subject
            levels.setdefault((s.part, s.source), {}).setdefault(s.level, set()).add(s.object_id)
        if any(len({frozenset(o) for o in by_level.values()}) > 1 for by_level in levels.values()):
            notes.append("levels rest on different objects; compare levels with --same-objects")
        return Results(run, rows, found.discoveries, found.unscored, tuple(notes))
