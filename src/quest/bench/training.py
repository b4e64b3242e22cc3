"""What is trained for tables: the published network and its variants, and rivals of their kind, on the same takes."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from quest.baselines.retrained.objective import KINDS, FollowPoints, save_retrained
from quest.baselines.retrained.windows import PointConfig, PointSampler, film
from quest.bench.settings import Making
from quest.bench.variants import Variant
from quest.data.provenance import code_commit, combined_hash
from quest.data.store import TakeStore
from quest.errors import ConfigError
from quest.evaluation.report import write_report
from quest.model.weights import find_weights
from quest.paper.network import PaperNetwork, read_paper
from quest.paper.objective import PaperStageOne
from quest.track.tracker import pick_device
from quest.train.batches import Sampler
from quest.train.checkpoint import load_checkpoint
from quest.train.dataset import open_dataset
from quest.train.loop import Objective, StepReport, fit
from quest.train.settings import TrainingConfig


def store_of(making: Making, name: str) -> TakeStore:
    """The takes of a name."""
    return TakeStore(making.work / "takes" / name)


def train_published(making: Making, variant: Variant, seed: int) -> Path:
    """The weights of one training of the published network, which goes on where it stopped."""
    teach, choose = store_of(making, "teach"), store_of(making, "choose")
    own = {
        "variant": variant.name,
        "batch": making.batch,
        "network": json.loads(variant.network.to_json()),
        "losses": dict(variant.losses),
        "order": variant.order,
        "windows": asdict(variant.windows),
    }
    folder = making.work / "runs" / variant.name / f"seed-{seed}"
    weights = _begun(making, folder, seed, own, making.steps)
    if weights.exists():
        return weights
    torch.manual_seed(seed)
    network = PaperNetwork(variant.network)
    take_encoder(network)
    dataset = open_dataset(
        network,
        stores=[teach.url],
        validation_stores=[choose.url],
        cache=making.work / "features",
        windows=replace(variant.windows, batch=making.batch),
        device=pick_device("auto"),
        report=lambda done, total, frames: None,
    )
    objective = PaperStageOne(network, variant.losses, order=variant.order)
    _fitted(making, objective, dataset.training, dataset.validation, folder, seed, making.steps)
    about = f"variant {variant.name}, seed {seed}, {making.steps} steps of {making.batch} windows"
    network.save(weights, about=about)
    return weights


def train_rival(making: Making, name: str, seed: int) -> Path:
    """The weights of one training of a rival named -retrained, which goes on where it stopped."""
    teach, choose = store_of(making, "teach"), store_of(making, "choose")
    kind = KINDS[name]
    shapes = kind.config()  # type: ignore[call-arg]  # each says how many frames
    windows = PointConfig(batch=kind.batch, frames=shapes.frames)
    own = {"rival": name, "network": json.loads(shapes.to_json()), "windows": asdict(windows)}
    folder = making.work / "runs" / name / f"seed-{seed}"
    weights = _begun(making, folder, seed, own, making.rival_steps)
    if weights.exists():
        return weights
    torch.manual_seed(seed)
    network = kind.network(shapes)
    samplers = [
        PointSampler(film(store, store.names(), making.work / "filmed", size=shapes.image_size), windows)
        for store in (teach, choose)
    ]
    training, validation = samplers
    _fitted(making, FollowPoints(name, network), training, validation, folder, seed, making.rival_steps)
    about = f"{name}, seed {seed}, {making.rival_steps} steps of {kind.batch} windows"
    save_retrained(name, network, weights, about=about)
    return weights


def take_encoder(network: PaperNetwork) -> None:
    """Give a network the frozen encoder of the shipped one."""
    network.encoder.load_state_dict(read_paper(find_weights("quest-paper")).network.encoder.state_dict())


def _fitted(
    making: Making, objective: Objective, training: Sampler, validation: Sampler, folder: Path, seed: int, steps: int
) -> None:
    """Train, and leave the last weights in the network, whatever their score."""
    config = TrainingConfig(
        steps=steps,
        optimizer="adamw",
        learning_rate=making.learning_rate,
        warmup_steps=max(1, min(100, steps // 10)),
        validate_every=steps,  # once, so that the best are the last weights
        validation_batches=2,
        seed=seed,
    )
    out = folder / "stage-1"
    out.mkdir(parents=True, exist_ok=True)
    best = fit(objective, training, validation, config, out=out, report=_silent)
    load_checkpoint(best, objective.network.cpu(), None)


def _silent(report: StepReport) -> None:
    """Trainings say nothing; their folder has the curves."""


def _begun(making: Making, folder: Path, seed: int, own: dict[str, Any], steps: int) -> Path:
    """Where the weights of a training are to lie; notes its settings and the commit that began it.

    Raises:
        ConfigError: the folder has a training of other settings.
    """
    stores = [store_of(making, name) for name in ("teach", "choose")]
    hashes = ((f"{i}/{name}", store.data_hash(name)) for i, store in enumerate(stores) for name in store.names())
    settings = own | {"seed": seed, "steps": steps, "learning_rate": making.learning_rate}
    settings["takes"] = combined_hash(hashes)
    file, weights = folder / "settings.json", folder / "weights.safetensors"
    if not file.exists():
        write_report(settings | {"commit": code_commit()}, file)
        return weights
    known = json.loads(file.read_text(encoding="utf-8"))
    for name, value in settings.items():
        if known.get(name) != value:
            raise ConfigError(
                f"{folder}: this training was begun with {name} {known.get(name)}, now it is {value}; use another "
                "--work, or remove this one"
            )
    return weights
