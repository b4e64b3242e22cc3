"""Batches in the order of a generator, the next one read while the present one is learned from."""

from __future__ import annotations

import json
from collections.abc import Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch


@runtime_checkable
class Part(Protocol):
    """Inputs or truth of examples, as tensors."""

    def to(self, device: torch.device) -> Part:
        """The same on a device."""
        ...


@runtime_checkable
class Plan(Protocol):
    """Examples of one batch, all that is random about them drawn and nothing large read."""

    def part(self, rows: slice, /) -> Plan:
        """Some of the examples."""
        ...


@runtime_checkable
class BatchSize(Protocol):
    """Settings of a sampler."""

    @property
    def batch(self) -> int:
        """Examples per step."""
        ...


@runtime_checkable
class Sampler(Protocol):
    """Where batches come from."""

    @property
    def config(self) -> BatchSize:
        """How they are drawn."""
        ...

    def plan(self, rng: np.random.Generator) -> Any:
        """What is in a batch, a :class:`Plan`."""
        ...

    def load(self, plan: Any, /) -> tuple[Any, Any]:
        """Inputs and truth, each a :class:`Part`, of what a plan names."""
        ...


class MicroBatch:
    """Examples that go through the network together."""

    # No dataclass: Fabric looks into those that a module is called with and cannot copy frozen ones.

    def __init__(self, frames: Part, truth: Part) -> None:
        self.frames = frames
        self.truth = truth

    def to(self, device: torch.device) -> MicroBatch:
        """The same on a device."""
        return MicroBatch(self.frames.to(device), self.truth.to(device))


@dataclass(frozen=True)
class Batch:
    """What one process learns from in one step."""

    parts: tuple[MicroBatch, ...]
    """Micro-batches."""
    rng: str
    """State of the generator after this batch was drawn and before the next one was, as JSON."""


def stream_batches(sampler: Sampler, rng: np.random.Generator, parts: Sequence[slice]) -> Generator[Batch, None, None]:
    """Batches without end; close it to end the reading.

    Args:
        sampler: where they come from.
        rng: generator that decides what is in them; every process has the same.
        parts: examples of a batch that each micro-batch of this process takes.
    """

    def read(plan: Plan) -> tuple[MicroBatch, ...]:
        return tuple(MicroBatch(*sampler.load(plan.part(rows))) for rows in parts)

    # One thread: the order of reading does not matter for what is read, but memory does.
    with ThreadPoolExecutor(1, thread_name_prefix="batches") as reader:
        ahead = reader.submit(read, sampler.plan(rng))
        while True:
            state = json.dumps(rng.bit_generator.state)
            present, ahead = ahead, reader.submit(read, sampler.plan(rng))
            yield Batch(present.result(), state)
