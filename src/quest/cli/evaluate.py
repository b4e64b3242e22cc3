"""``quest eval``: score trackers on takes of a store or on labelled real recordings, and print the tables."""

from __future__ import annotations

import time
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from tyro.extras import literal_type_from_choices

from quest.baselines import TRACKERS
from quest.wording import counted

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rich.progress import Progress

    from quest.baselines import ClipTracker
    from quest.cli.console import Console
    from quest.data.split import SplitPart
    from quest.data.store import TakeStore
    from quest.evaluation.finished import FinishedTakes
    from quest.evaluation.results import Results, Run
    from quest.evaluation.runner import Evaluated
    from quest.evaluation.selection import Shard

if TYPE_CHECKING:
    TrackerName = str
else:
    TrackerName = literal_type_from_choices(TRACKERS)

_TRACKERS_HELP = "What to compare. By default all that take part in --real, or quest, lk and hold-still. " + "; ".join(
    f"{name}: {entry.about}" for name, entry in TRACKERS.items()
)
_OF_TAKES = ("protocol", "split", "level", "objects", "same_objects", "shard")
_OF_REAL = ("quest", *(name for name, entry in TRACKERS.items() if entry.plain))


@dataclass(frozen=True)
class Eval:
    """Evaluate trackers on takes or on labelled real recordings: a table and, with --out, result files.

    With --out, what is done is kept beside it (OUT.parts) until the file is written: run a command that was stopped
    again and it goes on. Takes can be shared by several processes with --shard.

    On takes the protocol point always has the tracker hold-still for comparison; trackers that only follow given
    points do not have the protocol semantic. Formats, measures and trackers: docs/metrics.md.
    """

    takes: str | None = None
    """Folder of a take store."""
    real: tuple[Path, ...] = ()
    """Instead of --takes, folders of labelled recordings: clips with labels.csv or truth.csv, or pictures with
    labels.csv."""
    protocol: tuple[Literal["point", "semantic"], ...] = ("point",)
    """Point (the true pixel is given) and semantic (nothing is given)."""
    trackers: Annotated[tuple[TrackerName, ...], tyro.conf.arg(help=_TRACKERS_HELP)] = ()
    """What to compare."""
    weights: str = "quest-s16"
    """Name or file of the weights of the trackers that need some."""
    rivals: Path | None = None
    """Folder of code and weights of the rivals named -official; docs/metrics.md says what lies there."""
    split: tuple[Literal["train", "validation", "test", "unlisted"], ...] = ("validation", "test", "unlisted")
    """Parts of the object split; training objects are reported only if train is named here."""
    level: tuple[int, ...] = ()
    """Levels to evaluate; all by default."""
    objects: tuple[str, ...] = ()
    """Object ids to evaluate; all by default."""
    same_objects: bool = False
    """Keep only objects that have takes of every level, so that levels compare."""
    pictures: Literal["choosing", "teaching", "all"] = "choosing"
    """Of labelled pictures, the fifth that is for choosing, the rest, which may teach, or all."""
    resamples: int = 1000
    """Of the bootstrap over objects, clips or pictures."""
    seed: int = 0
    """Of the bootstrap."""
    shard: str = "0/1"
    """Part of the takes, such as 0/2 and 1/2 for two processes side by side; the last one reports. Needs --out."""
    out: Path | None = None
    """Of --takes a result file (.json); the per-frame records go beside it (.records.parquet). Of --real a folder, with
    a file for each set."""

    def run(self) -> int:
        """Evaluate, print the table, write the files.

        Raises:
            ConfigError: nothing to evaluate, or settings out of range.
            InputError: a set of recordings is missing or damaged.
            TakeError: the store is missing or a take is corrupt.
            WeightsError: weights, ours or a rival's, cannot be loaded.
        """
        from quest.errors import ConfigError

        if (self.takes is None) == (not self.real):
            raise ConfigError("eval: expected --takes STORE or --real FOLDER..., one of the two")
        if not self.protocol or self.resamples < 1 or self.seed < 0:
            raise ConfigError(
                f"eval: expected a protocol, resamples >= 1 and seed >= 0, got {self.protocol}, {self.resamples}, "
                f"{self.seed}"
            )
        return self._run_takes(self.takes) if self.takes is not None else self._run_real()

    def _run_real(self) -> int:
        import hashlib

        from quest.data.provenance import code_hash, package_versions
        from quest.errors import ConfigError
        from quest.evaluation.real.run import KeptAnswers, RealRow, evaluate_set, write_set
        from quest.evaluation.real.sets import open_set
        from quest.evaluation.real.table import FULL_WIDTH, real_table

        given = [f.name for f in fields(self) if f.name in _OF_TAKES and getattr(self, f.name) != f.default]
        if given:
            raise ConfigError(f"eval: --{given[0].replace('_', '-')} is for --takes; omit it with --real")
        if self.out is not None and self.out.suffix:
            raise ConfigError(f"eval: expected --out to be a folder, which gets a file for each set, got {self.out}")
        sets = [open_set(folder, part=self.pictures) for folder in self.real]
        names = [real.name for real in sets]
        if len(set(names)) < len(names):
            raise ConfigError(f"eval: expected sets of different names, got {', '.join(names)}; rename a folder")
        trackers = self._load_trackers(self.trackers or _OF_REAL)
        console, found = _stderr(), dict[str, list[RealRow]]()
        with _bar(console) as progress:
            task = progress.add_task("", total=sum(len(real.clips) + len(real.pictures) for real in sets))

            def advance(doing: str, done: int) -> None:
                progress.update(task, description=doing, advance=done)

            for real in sets:
                start_s, data_hash, kept = time.monotonic(), real.data_hash(), None
                if self.out is not None:
                    answers = [
                        code_hash(),
                        package_versions(),
                        self.weights,
                        weights_hash(trackers, self.weights),
                        rival_hashes(trackers),
                        data_hash,
                    ]
                    made_by = hashlib.sha256(repr([*answers, self.seed]).encode()).hexdigest()
                    kept = KeptAnswers(self.out / f"{real.name}.parts", made_by=made_by)
                rows, single = evaluate_set(
                    real, trackers, resamples=self.resamples, seed=self.seed, kept=kept, progress=advance
                )
                found[real.name] = rows
                if self.out is not None and kept is not None:
                    run = self._run(trackers, data_hash, start_s)
                    write_set(self.out / f"{real.name}.json", real.name, rows, single, run)
                    kept.remove()
        output = table_console(FULL_WIDTH)
        output.print(real_table(found, width=output.width))
        if self.out is not None:
            console.print(f"wrote {', '.join(str(self.out / f'{name}.json') for name in found)}", highlight=False)
        return 0

    def _run_takes(self, takes: str) -> int:
        from quest.cli.takes import open_store
        from quest.data.provenance import combined_hash
        from quest.errors import ConfigError
        from quest.evaluation.results import write_results
        from quest.evaluation.selection import Shard, select_takes
        from quest.evaluation.tables import FULL_WIDTH, results_table

        if self.out is not None and self.out.suffix != ".json":
            raise ConfigError(f"eval: expected --out to end in .json, got {self.out}")
        shard = Shard.parse(self.shard)
        if self.out is None and shard.count > 1:
            raise ConfigError(f"eval: --shard {self.shard} needs --out, beside which the processes share what is done")
        start_s = time.monotonic()
        store = open_store(takes)
        broken = sorted(store.problems())
        chosen = select_takes(
            store.infos(), split=self.split, levels=self.level, objects=self.objects, same_objects=self.same_objects
        )
        names = list(self.trackers or ("quest", "lk", "hold-still"))
        names += ["hold-still"] * ("point" in self.protocol)
        trackers = self._load_trackers(names)
        console = _stderr()
        finished = self._finished(trackers)
        found = self._evaluate(store, chosen, trackers, finished, shard, console)
        if found.missing:
            console.print(f"left to other shards: {counted(found.missing, 'take')}; nothing is reported yet")
            return 0
        data_hash = combined_hash((name, store.data_hash(name)) for name in chosen)
        results = self._results(found, broken, self._run(trackers, data_hash, start_s))
        output = table_console(FULL_WIDTH)
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
        answers.append(rival_hashes(trackers))
        digest = hashlib.sha256(repr([*answers, self.weights, weights_hash(trackers, self.weights)]).encode())
        return FinishedTakes(self.out.with_suffix(".parts"), made_by=digest.hexdigest())

    def _load_trackers(self, names: Sequence[str]) -> list[ClipTracker]:
        from quest.baselines import line_up

        return list(line_up(names, weights=self.weights, rivals=self.rivals))

    def _evaluate(
        self,
        store: TakeStore,
        chosen: Mapping[str, SplitPart],
        trackers: list[ClipTracker],
        finished: FinishedTakes | None,
        shard: Shard,
        console: Console,
    ) -> Evaluated:
        from quest.evaluation.runner import evaluate, has_protocol

        runs = sum(has_protocol(t, p) for t in trackers for p in self.protocol)
        headers = store.headers()
        own = [headers[name] for i, name in enumerate(chosen) if i in shard]
        frames = sum(header.frames * len(header.cameras) for header in own) * runs
        with _bar(console) as progress:
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

    def _run(self, trackers: Sequence[ClipTracker], data_hash: str, start_s: float) -> Run:
        return ended_run(trackers, self.weights, start_s, data_hash=data_hash, resamples=self.resamples, seed=self.seed)

    def _results(self, found: Evaluated, broken: list[str], run: Run) -> Results:
        from quest.evaluation.results import Results
        from quest.evaluation.summary import summarise

        rows = summarise(found.records, found.discoveries, resamples=self.resamples, seed=self.seed)
        notes = list(found.notes)
        if broken:
            notes.append(f"corrupt takes of the store were omitted: {', '.join(broken)}")
        levels: dict[tuple[str, str], dict[int, set[str]]] = {}
        for record in found.records:
            s = record.subject
            levels.setdefault((s.part, s.source), {}).setdefault(s.level, set()).add(s.object_id)
        if any(len({frozenset(o) for o in by_level.values()}) > 1 for by_level in levels.values()):
            notes.append("levels rest on different objects; compare levels with --same-objects")
        return Results(run, rows, found.discoveries, found.unscored, tuple(notes))


def weights_hash(trackers: Sequence[ClipTracker], weights: str) -> str | None:
    """Hash of the weights that trackers were made of, where it is known."""
    from quest.data.provenance import file_hash

    return next((h for t in trackers if (h := getattr(t, "weights_hash", None))), None) or file_hash(weights)


def rival_hashes(trackers: Sequence[ClipTracker]) -> list[str]:
    """Hashes of the official weights of rivals."""
    return [h for t in trackers if (h := getattr(t, "rival_hash", None))]


def ended_run(
    trackers: Sequence[ClipTracker], weights: str, start_s: float, *, data_hash: str, resamples: int, seed: int
) -> Run:
    """The run of this process, which began at a reading of the monotonic clock and ends now."""
    from quest.evaluation.results import Run

    of_weights = any(TRACKERS[tracker.name].of_weights for tracker in trackers)
    return Run.ended(
        start_s,
        data_hash=data_hash,
        weights=weights if of_weights else None,
        weights_hash=weights_hash(trackers, weights) if of_weights else None,
        resamples=resamples,
        seed=seed,
    )


def _stderr() -> Console:
    from quest.cli.console import Console

    return Console(stderr=True)


def table_console(full_width: int) -> Console:
    """The terminal; a file or pipe has no width of its own and gets every column."""
    from quest.cli.console import Console

    output = Console()
    return output if output.is_terminal else Console(width=full_width)


def _bar(console: Console) -> Progress:
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    return Progress(TextColumn("{task.description}"), *columns, console=console, transient=True)
