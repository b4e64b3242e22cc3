"""Batches in the order of a generator, the next ones read by other processes while the present one is learned from."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from quest.errors import QuestError


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


class _Reading(Dataset[Batch | QuestError | OSError]):
    """What becomes of the plans of batches in the process that reads."""

    def __init__(self, sampler: Sampler, parts: Sequence[slice]) -> None:
        self._sampler = sampler
        self._parts = parts

    def __getitem__(self, planned: tuple[Plan, str]) -> Batch | QuestError | OSError:  # type: ignore[override]
        plan, state = planned
        try:
            return Batch(tuple(MicroBatch(*self._sampler.load(plan.part(rows))) for rows in self._parts), state)
        except (QuestError, OSError) as error:  # raised by the process that asked, as it is
            return error


def _as_it_is(batch: Any) -> Any:
    return batch


def stream_batches(
    sampler: Sampler, rng: np.random.Generator, parts: Sequence[slice], *, readers: int
) -> Iterator[Batch]:
    """Batches without end.

    Args:
        sampler: where they come from.
        rng: generator that decides what is in them; every process has the same.
        parts: examples of a batch that each micro-batch of this process takes.
        readers: processes that read ahead; 0: none, a batch is read when it is asked for.
    """

    def plans() -> Iterator[tuple[Plan, str]]:
        while True:
            plan = sampler.plan(rng)
            yield plan, json.dumps(rng.bit_generator.state)

    loader = DataLoader(
        _Reading(sampler, parts),
        batch_size=None,
        sampler=plans(),
        num_workers=readers,
        collate_fn=_as_it_is,
        generator=torch.Generator(),  # of its own: the one that all share is the network's
    )
    for batch in loader:
        if not isinstance(batch, Batch):
            raise batch
        yield batch
