"""``quest eval``: score trackers on takes of a store or on labelled real recordings, and print the tables."""

from __future__ import annotations

import hashlib
import time
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from tyro.extras import literal_type_from_choices

from quest.baselines import TRACKERS, line_up
from quest.cli.console import Console
from quest.cli.progress import advancing
from quest.cli.takes import open_store, table_console
from quest.data.provenance import code_hash, file_hash, package_versions
from quest.errors import ConfigError
from quest.wording import counted

if TYPE_CHECKING:
    from collections.abc import Sequence

    from quest.baselines import ClipTracker
    from quest.evaluation.results import Results, Run
    from quest.evaluation.runner import Evaluated

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
    """Folder of code and weights of the rivals named -official and of weights those named -retrained; docs/metrics.md
    says what lies there."""
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
        """Evaluate, print the table, write the files."""
        if (self.takes is None) == (not self.real):
            raise ConfigError("eval: expected --takes STORE or --real FOLDER..., one of the two")
        if not self.protocol or self.resamples < 1 or self.seed < 0:
            raise ConfigError(
                f"eval: expected a protocol, resamples >= 1 and seed >= 0, got {self.protocol}, {self.resamples}, "
                f"{self.seed}"
            )
        return self._run_takes(self.takes) if self.takes is not None else self._run_real()

    def _run_real(self) -> int:
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
        lineup = Lineup.of(self.trackers or _OF_REAL, self.weights, self.rivals)
        console, found = Console(stderr=True, soft_wrap=False), dict[str, list[RealRow]]()
        with advancing(console, sum(len(real.clips) + len(real.pictures) for real in sets)) as advance:
            for real in sets:
                start_s, data_hash, kept = time.monotonic(), real.data_hash(), None
                if self.out is not None:
                    made_by = lineup.digest(data_hash, self.seed)
                    kept = KeptAnswers(self.out / f"{real.name}.parts", made_by=made_by)
                bootstrap = {"resamples": self.resamples, "seed": self.seed}
                rows, single = evaluate_set(real, lineup.trackers, **bootstrap, kept=kept, progress=advance)
                found[real.name] = rows
                if self.out is not None and kept is not None:
                    run = lineup.ended(start_s, data_hash=data_hash, **bootstrap)
                    write_set(self.out / f"{real.name}.json", real.name, rows, single, run)
                    kept.remove()
        output = table_console(FULL_WIDTH, markup=True)
        output.print(real_table(found, width=output.width))
        if self.out is not None:
            console.print(f"wrote {', '.join(str(self.out / f'{name}.json') for name in found)}")
        return 0

    def _run_takes(self, takes: str) -> int:
        from quest.evaluation.finished import FinishedTakes
        from quest.evaluation.results import write_results
        from quest.evaluation.runner import evaluate, has_protocol
        from quest.evaluation.selection import Shard, hash_of, select_takes
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
        names = [*(self.trackers or ("quest", "lk", "hold-still")), *["hold-still"] * ("point" in self.protocol)]
        lineup, finished = Lineup.of(names, self.weights, self.rivals), None
        if self.out is not None:
            made_by = lineup.digest(self.protocol, [t.name for t in lineup.trackers], self.seed)
            finished = FinishedTakes(self.out.with_suffix(".parts"), made_by=made_by)
        console, headers = Console(stderr=True, soft_wrap=False), store.headers()
        own = [headers[name] for i, name in enumerate(chosen) if i in shard]
        runs = sum(has_protocol(t, p) for t in lineup.trackers for p in self.protocol)
        with advancing(console, sum(header.frames * len(header.cameras) for header in own) * runs) as advance:
            found = evaluate(
                store,
                chosen,
                lineup.trackers,
                protocols=self.protocol,
                finished=finished,
                shard=shard,
                progress=advance,
            )
        if found.missing:
            console.print(f"left to other shards: {counted(found.missing, 'take')}; nothing is reported yet")
            return 0
        bootstrap = {"resamples": self.resamples, "seed": self.seed}
        run = lineup.ended(start_s, data_hash=hash_of([(store, chosen)]), **bootstrap)
        results, output = self._results(found, broken, run), table_console(FULL_WIDTH, markup=True)
        output.print(results_table(results, width=output.width))
        if self.out is not None and finished is not None:
            write_results(results, self.out, records=found.records)
            console.print(f"wrote {self.out}")
            finished.remove()
        return 0

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


@dataclass(frozen=True)
class Lineup:
    """Trackers that are compared, and what their answers depend on."""

    trackers: list[ClipTracker]
    """By the names that were given, each once."""
    weights: str
    """Of those that need some."""

    @classmethod
    def of(cls, names: Sequence[str], weights: str, rivals: Path | None) -> Lineup:
        """Load trackers by their names."""
        return cls(list(line_up(names, weights=weights, rivals=rivals)), weights)

    @property
    def weights_hash(self) -> str | None:
        """Hash of the weights that trackers were made of, where it is known."""
        return next((h for t in self.trackers if (h := getattr(t, "weights_hash", None))), None) or file_hash(
            self.weights
        )

    def digest(self, *asked: object) -> str:
        """What tells apart answers of other code, packages, weights, or to other questions."""
        rivals = [h for t in self.trackers if (h := getattr(t, "rival_hash", None))]
        made_by = [code_hash(), package_versions(), self.weights, self.weights_hash, rivals, *asked]
        return hashlib.sha256(repr(made_by).encode()).hexdigest()

    def ended(self, start_s: float, *, data_hash: str, resamples: int, seed: int) -> Run:
        """The run of this process, which began at a reading of the monotonic clock and ends now."""
        from quest.evaluation.results import Run

        of_weights = any(TRACKERS[tracker.name].of_weights for tracker in self.trackers)
        weights, own_hash = (self.weights, self.weights_hash) if of_weights else (None, None)
        bootstrap = {"resamples": resamples, "seed": seed}
        return Run.ended(start_s, data_hash=data_hash, weights=weights, weights_hash=own_hash, **bootstrap)
