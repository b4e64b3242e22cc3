"""Ablation tables of the published network: train every variant for a fixed number of steps, evaluate, tabulate.

    python benchmarks/ablations.py --train TAKES/train --validation TAKES/validation --test TAKES/test \
        --work runs/ablations --encoder encoder.safetensors --steps 1500

One run is one variant and seed: a folder with checkpoints and `weights.safetensors`. The encoder is frozen and all
variants share its features, in training and in evaluation. Everything goes on where it stopped: interrupt the script
and run it again with the same arguments, or run it for some --tables or --seeds first and for all of them in the end.

Every run has the same steps, windows and schedule, and its last weights count: nothing is chosen by validation.
docs/metrics.md says what every row is. The tables rest on the runs that are there: rows and seeds that were not asked
for are left out.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from ablation_rows import Answers, ablation_rows
from ablation_variants import TABLES, Line, TableName, Variant, chosen_lines
from cached_encoder import serve_cached
from rich.console import Console

from quest.baselines import TRACKERS
from quest.data.provenance import code_commit, combined_hash, file_hash
from quest.data.split import SplitPart
from quest.data.store import TakeStore
from quest.errors import ConfigError
from quest.evaluation.protocols import ClipTracker, ProtocolName
from quest.evaluation.records import read_records
from quest.evaluation.report import provenance, write_report
from quest.evaluation.results import Results, Run, read_results, records_path, write_results
from quest.evaluation.runner import evaluate, has_protocol
from quest.evaluation.selection import Chosen, hash_of, select_in
from quest.paper.network import PaperNetwork, read_paper
from quest.paper.objective import PaperStageOne
from quest.paper.tracker import PaperTracker
from quest.track.tracker import pick_device
from quest.train.checkpoint import load_checkpoint
from quest.train.dataset import load_initial_encoder, open_dataset
from quest.train.loop import StepReport, fit
from quest.train.settings import TrainingConfig

ROOT = Path(__file__).parents[1]


@dataclass(frozen=True)
class Ablations:
    """Train, evaluate and tabulate variants of the published network and of its training."""

    train: tuple[str, ...]
    """Stores with takes of training objects; thinned ones will do."""
    validation: tuple[str, ...]
    """Stores with takes of validation objects, for the score that the last step prints."""
    test: tuple[str, ...]
    """Stores with whole takes to evaluate on."""
    encoder: Path
    """Weights of the frozen encoder (quest weights import-encoder)."""
    work: Path = ROOT / "runs" / "ablations"
    """Folder for features, runs and answers."""
    tables: tuple[TableName, ...] = TABLES
    """Tables to rebuild."""
    variants: tuple[str, ...] = ()
    """Names of variants (folders of their runs) to make rows of; all by default."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of every variant."""
    steps: int = 1500
    """Steps of every run."""
    batch: int = 16
    """Windows per step."""
    optimizer: Literal["muon", "adamw"] = "muon"
    """Of every run (see quest train)."""
    learning_rate: float = 2e-3
    """Peak of the schedule."""
    split: tuple[SplitPart, ...] = ("test",)
    """Parts of the object split to evaluate on."""
    level: tuple[int, ...] = ()
    """Levels to evaluate; all by default."""
    same_objects: bool = False
    """Keep only objects that have takes of every level, so that levels compare."""
    protocols: tuple[ProtocolName, ...] = ("point", "semantic")
    """Protocols to evaluate under, as far as a tracker has them."""
    resamples: int = 1000
    """Of the bootstrap over objects."""
    out: Path = ROOT / "benchmarks" / "results" / "ablations"
    """Folder of the tables."""

    def run(self) -> int:
        """Every run, every answer, every table."""
        console = Console(highlight=False)
        lines = chosen_lines(self.tables, self.variants)
        needed = {line.variant.name: line.variant for each in lines.values() for line in each}
        for seed in self.seeds:
            for number, item in enumerate(needed.values(), start=1):
                console.print(f"seed {seed}, variant {number}/{len(needed)}: {item.name}")
                weights = self._trained(item, seed, console)
                names = {line.tracker for each in lines.values() for line in each if line.variant == item}
                self._answer(item, seed, weights, sorted(names), console)
        for table, each in lines.items():
            self._write(table, each)
            console.print(f"wrote {self.out / f'{table}.json'}")
        return 0

    # Training

    def _trained(self, item: Variant, seed: int, console: Console) -> Path:
        """The weights of one run, trained as far as they are not yet: the last ones, whatever their score."""
        folder = self.work / "runs" / item.name / f"seed-{seed}"
        weights = folder / "weights.safetensors"
        self._check(folder, self._settings(item, seed))
        if weights.exists():
            return weights
        torch.manual_seed(seed)
        network = PaperNetwork(item.network)
        load_initial_encoder(network, self.encoder)
        dataset = open_dataset(
            network,
            stores=self.train,
            validation_stores=self.validation,
            cache=self.work / "features",
            windows=replace(item.windows, batch=self.batch),
            device=pick_device("auto"),
            report=lambda done, total, frames: None,
        )
        config = TrainingConfig(
            steps=self.steps,
            optimizer=self.optimizer,
            learning_rate=self.learning_rate,
            warmup_steps=max(1, min(100, self.steps // 10)),
            validate_every=self.steps,  # once, so that the best are the last weights
            validation_batches=2,
            seed=seed,
        )

        def report(done: StepReport) -> None:
            if done.step % 100 == 0 or done.scores is not None:
                console.print(f"  step {done.step}: loss {done.loss:.3f} {done.scores or ''}")

        objective, out = PaperStageOne(network, item.losses, order=item.order), folder / "stage-1"
        out.mkdir(parents=True, exist_ok=True)
        best = fit(objective, dataset.training, dataset.validation, config, out=out, report=report)
        load_checkpoint(best, network.cpu(), None)
        network.save(weights, about=f"ablation {item.name}, seed {seed}, {self.steps} steps of {self.batch} windows")
        return weights

    def _settings(self, item: Variant, seed: int) -> dict[str, Any]:
        return {
            "variant": item.name,
            "seed": seed,
            "steps": self.steps,
            "batch": self.batch,
            "optimizer": self.optimizer,
            "learning_rate": self.learning_rate,
            "network": json.loads(item.network.to_json()),
            "losses": item.losses,
            "order": item.order,
            "windows": asdict(item.windows),
            "encoder": file_hash(self.encoder),
            "training_hash": self.training_hash,
        }

    def _check(self, folder: Path, settings: dict[str, Any]) -> None:
        """Refuse to mix runs of other settings; note the commit that began a run."""
        file = folder / "settings.json"
        if not file.exists():
            write_report(settings | {"commit": code_commit()}, file)
            return
        known = json.loads(file.read_text(encoding="utf-8"))
        for name, value in settings.items():
            if known.get(name) != value:
                raise ConfigError(
                    f"{folder}: this run was made with {name} {known.get(name)}, now it is {value}; use another "
                    "--work, or remove the folder"
                )

    # Evaluation

    def _answer(self, item: Variant, seed: int, weights: Path, names: Sequence[str], console: Console) -> None:
        """Every tracker's answers with these weights, as far as they are not there yet."""
        for name in names:
            if self._answered(self._answers_file(item, seed, name), weights):
                continue
            start_s = time.monotonic()
            one = self._tracker(weights) if name == PaperTracker.name else TRACKERS[name].build(name)
            protocols: list[ProtocolName] = [p for p in self.protocols if has_protocol(one, p)]
            found = (
                [evaluate(s, takes, [one], protocols=protocols) for s, takes in self.test_takes] if protocols else []
            )
            run = Run.ended(
                start_s,
                data_hash=hash_of(self.test_takes),
                weights=item.name,
                weights_hash=file_hash(weights),
                resamples=self.resamples,
                seed=seed,
            )
            records = tuple(record for each in found for record in each.records)
            discoveries = tuple(discovery for each in found for discovery in each.discoveries)
            asked = Results(run, (), discoveries, notes=self.protocols)
            write_results(asked, self._answers_file(item, seed, name), records=records)
            console.print(f"  {name}: {len(records)} answers")

    def _tracker(self, weights: Path) -> ClipTracker:
        network = read_paper(weights).network
        serve_cached(network, self.work / "encoded")
        return PaperTracker(network, device=pick_device("auto"))

    def _answers_file(self, item: Variant, seed: int, tracker: str) -> Path:
        return self.work / "runs" / item.name / f"seed-{seed}" / "answers" / f"{tracker}.json"

    def _answered(self, file: Path, weights: Path) -> bool:
        if not file.exists():
            return False
        results = read_results(file)
        same = results.run.data_hash == hash_of(self.test_takes) and results.run.weights_hash == file_hash(weights)
        return same and {*results.notes} >= {*self.protocols}

    # Tables

    def _write(self, table: str, lines: Sequence[Line]) -> None:
        answers, commits = [], set()
        for line, seed in product(lines, self.seeds):
            file = self._answers_file(line.variant, seed, line.tracker)
            records = read_records(records_path(file)) if records_path(file).exists() else ()
            results = read_results(file)
            answers.append(Answers(line.label, seed, records, results.discoveries, line.reference))
            settings = json.loads((file.parents[1] / "settings.json").read_text(encoding="utf-8"))
            commits |= {settings["commit"], results.run.commit}
        same = ("steps", "batch", "optimizer", "learning_rate", "seeds", "training_hash", "resamples")
        report = provenance() | {name: getattr(self, name) for name in same} | {
            "run_commits": sorted(commits),
            "n_takes": sum(len(takes) for _, takes in self.test_takes),
            "data_hash": hash_of(self.test_takes),
            "encoder": file_hash(self.encoder),
            "rows": ablation_rows(answers, resamples=self.resamples, seed=0),
        }  # fmt: skip
        write_report(report, self.out / f"{table}.json")

    @cached_property
    def test_takes(self) -> Chosen:
        """Takes to evaluate on, by store."""
        choice = {"split": self.split, "levels": self.level, "same_objects": self.same_objects}
        return select_in([TakeStore(path) for path in self.test], **choice)

    @cached_property
    def training_hash(self) -> str:
        """One hash over all takes that may teach or be scored in training."""
        roles = {"train": self.train, "validation": self.validation}
        stores = [(role, TakeStore(path)) for role, paths in roles.items() for path in paths]
        return combined_hash(
            (f"{role}/{name}", store.data_hash(name)) for role, store in stores for name in store.names()
        )


if __name__ == "__main__":
    raise SystemExit(tyro.cli(Ablations).run())
