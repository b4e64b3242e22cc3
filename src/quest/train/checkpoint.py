"""Checkpoints of a training run: weights and optimiser state as safetensors, the rest as JSON.

A checkpoint is a folder that is written beside its place and renamed, so that it is whole or absent.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from jaxtyping import UInt8
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import nn

from quest.errors import WeightsError
from quest.model.config import StoredConfig
from quest.model.encoder import load_exactly
from quest.model.tensor_file import save_tensors

_GENERATOR = "generator."


@dataclass(frozen=True)
class Progress:
    """Where a training run stands."""

    step: int
    """Optimiser steps done."""
    best: float
    """Best validation score so far, of the kind that the objective is judged by; less is better."""
    best_step: int
    """Step of the best score."""
    stale: int
    """Validations since the best."""
    rng: str
    """State of the generator that draws windows, as JSON."""
    network: str
    """The network's configuration, as JSON."""
    objective: str = "stage-1"
    """Name of what is learned."""
    begun: str = ""
    """Hash of the weights that the run began with; empty in checkpoints from before it was kept."""


def save_checkpoint(
    folder: Path,
    network: nn.Module,
    optimizer: torch.optim.Optimizer,
    progress: Progress,
    generators: Mapping[str, UInt8[torch.Tensor, "R N"]] | None = None,
) -> None:
    """Write or replace a checkpoint; what of the encoder does not learn is left out.

    States of torch's generators are by the kind of device, one row per process.

    Raises:
        WeightsError: it cannot be written; the one before stays.
    """
    partial = folder.with_name(f".partial-{folder.name}")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    frozen = _frozen(network)
    weights = {name: tensor.contiguous() for name, tensor in network.state_dict().items() if name not in frozen}
    save_tensors(weights, partial / "weights.safetensors")
    state = optimizer.state_dict()
    tensors = {f"{i}.{key}": value.contiguous() for i, entry in state["state"].items() for key, value in entry.items()}
    tensors |= {f"{_GENERATOR}{kind}": rows.contiguous() for kind, rows in (generators or {}).items()}
    save_tensors(tensors, partial / "optimizer.safetensors")
    groups = [{k: v for k, v in group.items() if k != "params"} for group in state["param_groups"]]
    (partial / "progress.json").write_text(json.dumps({"progress": asdict(progress), "groups": groups}))
    old = folder.with_name(f".old-{folder.name}")
    if folder.exists():
        # Otherwise the old one is all there is, and stays until the new one has its name.
        shutil.rmtree(old, ignore_errors=True)
        folder.rename(old)
    partial.rename(folder)
    shutil.rmtree(old, ignore_errors=True)


def load_checkpoint(folder: Path, network: nn.Module, optimizer: torch.optim.Optimizer | None) -> Progress:
    """Read a checkpoint into a network and, to go on training, its optimiser.

    Raises:
        WeightsError: the checkpoint is missing, torn, or of another network.
    """
    asked, folder = folder, _present(folder)
    try:
        text = json.loads((folder / "progress.json").read_text())
        progress, saved_groups = Progress(**text["progress"]), text["groups"]
        weights = load_file(folder / "weights.safetensors")
        tensors = load_file(folder / "optimizer.safetensors")
    except (OSError, ValueError, KeyError, TypeError, SafetensorError) as error:
        raise WeightsError(f"{asked}: checkpoint is missing or torn ({error}); remove it to start anew") from error
    frozen = _frozen(network)
    own = {name: tensor for name, tensor in network.state_dict().items() if name in frozen}
    load_exactly(network, {**own, **weights}, what=f"checkpoint {folder}")
    if optimizer is not None:
        state = {name: tensor for name, tensor in tensors.items() if not name.startswith(_GENERATOR)}
        _load_optimizer(optimizer, state, saved_groups, folder)
    return progress


def load_generators(folder: Path) -> dict[str, UInt8[torch.Tensor, "R N"]]:
    """States of torch's generators in a checkpoint that can be read, by the kind of device, one row per process."""
    tensors = load_file(_present(folder) / "optimizer.safetensors")
    return {name.removeprefix(_GENERATOR): rows for name, rows in tensors.items() if name.startswith(_GENERATOR)}


def _present(folder: Path) -> Path:
    """The checkpoint, or the one before if the process was killed between the two renames of a replacement."""
    return folder if folder.exists() else folder.with_name(f".old-{folder.name}")


def _load_optimizer(
    optimizer: torch.optim.Optimizer, tensors: dict[str, torch.Tensor], saved_groups: list[dict], folder: Path
) -> None:
    try:
        state: dict[int, dict[str, torch.Tensor]] = {}
        for name, tensor in tensors.items():
            index, key = name.split(".", 1)
            state.setdefault(int(index), {})[key] = tensor
        groups = optimizer.state_dict()["param_groups"]
        merged = [{**new, **saved} for new, saved in zip(groups, saved_groups, strict=True)]
        optimizer.load_state_dict({"state": state, "param_groups": merged})
    except (ValueError, TypeError) as error:
        raise WeightsError(
            f"{folder}: the optimiser's state is of another network ({error}); remove it to start anew"
        ) from error


def check_same_run(progress: Progress, config: StoredConfig, objective: str, begun: str, folder: Path) -> None:
    """Refuse to resume with another network or objective, or from other weights: what is not trained is kept too.

    Raises:
        WeightsError: the checkpoint's differs.
    """
    if progress.objective != objective:
        raise WeightsError(
            f"{folder}: expected a run of {objective}, got one of {progress.objective}; use another --out"
        )
    # Parsed, so that a run that was started before a setting came up goes on with its default.
    if type(config).from_json(progress.network) != config:
        raise WeightsError(f"{folder}: this run was started with another network; use another --out or its settings")
    if progress.begun not in ("", begun):
        raise WeightsError(f"{folder}: this run began with other weights; use another --out, or the weights of then")


def _frozen(network: nn.Module) -> set[str]:
    """Tensors of the encoder that do not learn: it has its own file."""
    return {name for name, p in network.named_parameters() if name.startswith("encoder.") and not p.requires_grad}
