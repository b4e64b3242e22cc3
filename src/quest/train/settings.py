"""Settings of training, free of heavy imports so that the command line is quick."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

from quest.errors import ConfigError

Accelerator = Literal["auto", "cpu", "cuda", "mps"]

_SEEDS = 2**64
"""As many seeds torch's generators take."""


@dataclass(frozen=True)
class TrainingConfig:
    """How a network is trained."""

    steps: int = 3000
    """Optimiser steps at most."""
    optimizer: Literal["muon", "adamw"] = "muon"
    """``muon`` for the matrices inside the network and AdamW for all else, or ``adamw`` for everything, as
    published."""
    learning_rate: float = 2e-3
    """Peak of the schedule (linear warm-up, then cosine to a twentieth)."""
    refined_rate: float = 0.1
    """Learning rate of what was trained before on much more than is learned from here, such as the blocks of the
    vision transformer, as a share of that of all else; 0 leaves it as it is."""
    weight_decay: float = 0.01
    """A step takes this times the learning rate off every weight, as a share of it."""
    warmup_steps: int = 100
    """Steps of the warm-up."""
    clip_norm: float = 1.0
    """Largest norm of the gradient."""
    average_decay: float = 0.995
    """Share of the running mean of the weights that a step keeps; the mean is what is validated and becomes the best
    checkpoint. 0: the weights themselves."""
    validate_every: int = 250
    """Steps between validations."""
    checkpoint_every: int = 100
    """Steps between checkpoints, beside those at validations: what a kill can cost."""
    validation_batches: int = 12
    """Fixed batches per validation."""
    patience: int = 15
    """Validations without a better score before training stops."""
    seed: int = 0
    """Seed of windows and of initial weights."""
    precision: str = "auto"
    """``bf16-mixed``, ``32-true``, or ``auto`` for bfloat16 where it is fast."""
    accelerator: Accelerator = "auto"
    """``cpu``, ``cuda``, ``mps``, or ``auto`` for the best there is."""
    devices: int | Literal["auto"] = 1
    """Processes on this machine, each with a device of its own, or ``auto`` for as many as there are GPUs. Under
    ``torchrun`` its number of processes counts, and this does not."""
    accumulate: int = 1
    """Micro-batches that a step is divided into, to save memory. The batch stays what it is, and so does the gradient;
    that takes an additional forward pass."""
    readers: int = 1
    """Processes that read batches ahead, for each that trains; 0: none. A GPU needs many."""
    compile: bool = False
    """Whether to compile the parts of the network that do most of the work, which takes minutes at first."""
    deterministic: bool = False
    """Whether to use deterministic algorithms alone, with a warning where there is none."""

    def __post_init__(self) -> None:
        counts = ("steps", "validate_every", "checkpoint_every", "validation_batches", "patience", "accumulate")
        for name in counts:
            if getattr(self, name) < 1:
                raise ConfigError(f"training: expected {name} to be at least 1, got {getattr(self, name)}")
        for name in ("learning_rate", "clip_norm"):
            if not 0 < getattr(self, name) < math.inf:
                raise ConfigError(f"training: expected {name} above 0, got {getattr(self, name)}")
        for name in ("refined_rate", "weight_decay", "warmup_steps", "readers", "seed"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ConfigError(f"training: expected {name} to be at least 0, got {getattr(self, name)}")
        if self.seed >= _SEEDS:
            raise ConfigError(f"training: expected seed below 2**64, got {self.seed}")
        if self.accelerator not in get_args(Accelerator):
            known = ", ".join(get_args(Accelerator))
            raise ConfigError(f"training: expected accelerator {known}, got {self.accelerator!r}")
        if self.optimizer not in ("muon", "adamw"):
            raise ConfigError(f"training: expected optimizer muon or adamw, got {self.optimizer!r}")
        if not 0 <= self.average_decay < 1:
            raise ConfigError(f"training: expected average_decay from 0 to below 1, got {self.average_decay}")
        if self.devices != "auto" and self.devices < 1:
            raise ConfigError(f"training: expected at least one device or 'auto', got devices {self.devices}")
        if self.precision not in ("auto", "bf16-mixed", "32-true"):
            raise ConfigError(f"training: expected precision auto, bf16-mixed or 32-true, got {self.precision!r}")


@dataclass(frozen=True)
class WindowConfig:
    """How windows are drawn and disturbed."""

    batch: int = 16
    """Windows per step, of all processes and micro-batches together."""
    max_stride: int = 3
    """Largest step between the frames of a window, in stored frames (0 repeats one frame)."""
    first_frame_share: float = 0.6
    """How often the anchor is the first frame in which most entities are seen."""
    depth_drop_share: float = 0.08
    """How often a window loses all depth."""

    def __post_init__(self) -> None:
        if self.batch < 1:
            raise ConfigError(f"windows: expected batch to be at least 1, got {self.batch}")
        if self.max_stride < 0:
            raise ConfigError(f"windows: expected max_stride to be at least 0, got {self.max_stride}")
        for name in ("first_frame_share", "depth_drop_share"):
            if not 0 <= getattr(self, name) <= 1:
                raise ConfigError(f"windows: expected {name} from 0 to 1, got {getattr(self, name)}")
