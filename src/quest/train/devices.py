"""Where training runs: devices, processes, and the state of their generators."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from quest.errors import ConfigError
from quest.extras import require
from quest.model.precision import fast_bfloat16
from quest.train.settings import TrainingConfig

if TYPE_CHECKING:
    from lightning_fabric import Fabric


def launch(config: TrainingConfig) -> Fabric:
    """Start the processes of a training run; what follows the call runs in each of them.

    With more than one device, the program is started again for every other process with the same arguments, so call
    this before anything that should happen once. Under ``torchrun`` the processes are there already.

    Raises:
        ConfigError: there is no such accelerator, or there are not as many devices.
        MissingExtraError: Lightning Fabric is not installed.
    """
    lightning_fabric = require("lightning_fabric")
    from lightning_fabric.utilities.exceptions import MisconfigurationException

    if config.deterministic:
        # cuBLAS reads it when a process first uses it: https://docs.nvidia.com/cuda/cublas/#results-reproducibility
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    else:
        torch.backends.cudnn.benchmark = True  # batches of one size: it pays to look for the quickest way once
    nodes, devices = _processes(config)
    strategy = "auto"
    if nodes * devices > 1:
        from lightning_fabric.strategies.ddp import DDPStrategy

        # No layer keeps statistics, so there is no buffer to send around before every step.
        strategy = DDPStrategy(broadcast_buffers=False, gradient_as_bucket_view=True)
    try:
        fabric = lightning_fabric.Fabric(
            accelerator=config.accelerator,
            devices=devices,
            num_nodes=nodes,
            strategy=strategy,
            precision=_precision(config),
        )
    except (RuntimeError, ValueError, MisconfigurationException) as error:
        raise ConfigError(
            f"training: cannot use {devices} devices of accelerator {config.accelerator!r} ({error}); choose "
            "others with --training.accelerator and --training.devices"
        ) from error
    fabric.launch()
    return fabric


def _precision(config: TrainingConfig) -> str:
    """In which precision the device computes that Fabric will choose."""
    if config.precision != "auto":
        return config.precision
    kinds = ("cuda", "mps") if config.accelerator == "auto" else (config.accelerator,)
    there = {"cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available()}
    device = torch.device(next((kind for kind in kinds if there.get(kind)), "cpu"))
    return "bf16-mixed" if fast_bfloat16(device) else "32-true"


def _processes(config: TrainingConfig) -> tuple[int, int]:
    """Machines, and processes on each."""
    if torch.distributed.is_available() and torch.distributed.is_torchelastic_launched():
        here = int(os.environ["LOCAL_WORLD_SIZE"])
        return int(os.environ["WORLD_SIZE"]) // here, here
    if config.devices != "auto":
        return 1, config.devices
    return 1, max(1, torch.cuda.device_count()) if config.accelerator in ("auto", "cuda") else 1


def divide(batch: int, *, rank: int, processes: int, accumulate: int) -> list[slice]:
    """Windows of a batch that one process works on, a slice per micro-batch.

    Raises:
        ConfigError: the batch cannot be divided evenly.
    """
    parts = processes * accumulate
    if batch % parts:
        raise ConfigError(
            f"training: a batch of {batch} windows cannot be divided evenly among {processes} processes with "
            f"{accumulate} micro-batches each; make --windows.batch a multiple of {parts}"
        )
    size = batch // parts
    first = [(step * processes + rank) * size for step in range(accumulate)]
    return [slice(start, start + size) for start in first]


def generator_states(fabric: Fabric) -> dict[str, UInt8[Tensor, "R N"]]:
    """States of torch's generators in all processes, by the kind of device; every process has to ask."""
    states = {"cpu": torch.get_rng_state()}
    if fabric.device.type == "cuda":
        states["cuda"] = torch.cuda.get_rng_state(fabric.device)
    rows = {}
    for kind, state in states.items():
        gathered = fabric.all_gather(state) if fabric.world_size > 1 else state
        assert isinstance(gathered, Tensor)
        rows[kind] = gathered.reshape(fabric.world_size, -1).cpu()
    return rows


def part_ways(fabric: Fabric, seed: int) -> None:
    """Give every process but the first random numbers of its own: each drops other parts of what it learns from."""
    if fabric.global_rank:
        torch.manual_seed(int(np.random.SeedSequence((seed, fabric.global_rank)).generate_state(1)[0]))


def restore_generators(fabric: Fabric, states: dict[str, UInt8[Tensor, "R N"]]) -> None:
    """Take up this process's states; a process that had none keeps its own."""
    rank = fabric.global_rank
    if "cpu" in states and rank < len(states["cpu"]):
        torch.set_rng_state(states["cpu"][rank].contiguous())
    if "cuda" in states and fabric.device.type == "cuda" and rank < len(states["cuda"]):
        torch.cuda.set_rng_state(states["cuda"][rank].contiguous(), fabric.device)


@contextmanager
def deterministic_algorithms(wanted: bool) -> Iterator[None]:
    """Deterministic algorithms inside, with a warning where an operation has none."""
    before = torch.are_deterministic_algorithms_enabled(), torch.is_deterministic_algorithms_warn_only_enabled()
    if wanted:
        torch.use_deterministic_algorithms(True, warn_only=True)
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(before[0], warn_only=before[1])
