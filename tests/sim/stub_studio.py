"""A studio that makes small takes without rendering, so that productions are tested in seconds.

It can be imported by workers of a cluster and by processes that are killed.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import zarr  # noqa: F401 (a fork of this process finds it imported)

from quest.data.store import TakeStore
from quest.errors import ObjectError, RendererError
from quest.sim.plan import TakeSpec
from quest.sim.production import Studio, missing_takes, produce
from quest.types import Take
from tests.synthetic import make_take


@dataclass
class StubStudio(Studio):
    """A studio that renders nothing."""

    seconds: float = 0.0
    """How long a take takes at least."""
    impossible: tuple[str, ...] = ()
    """Names of takes that cannot be made."""
    deadly: tuple[str, ...] = ()
    """Names of takes that kill the process that makes them."""
    notes: Path | None = None
    """Folder for what tests want to know: who made what."""

    broken: bool = False
    """Whether it cannot be set up."""

    def open(self, specs: Sequence[TakeSpec], *, complete: bool = False) -> None:
        """Nothing to set up."""
        if self.broken:
            raise RendererError("no device can render")

    def describe(self) -> dict[str, Any]:
        return {"renderer": "stub"}

    def make(self, spec: TakeSpec) -> tuple[Take, tuple[str, ...]]:
        if spec.name in self.impossible:
            raise ObjectError(f"{spec.object_id}: impossible")
        time.sleep(self.seconds)
        if self.notes is not None:
            (self.notes / f"made-{spec.name}-{os.getpid()}").touch()
        if spec.name in self.deadly:
            os.kill(os.getpid(), signal.SIGKILL)
        take = make_take(frames=12, views=1, entities=2, size=(32, 32), seed=spec.seed, name=spec.name)
        return replace(take, info=replace(take.info, provenance={"maker": os.getpid()})), ("wobbly",)


def plan(count: int) -> list[TakeSpec]:
    """Specifications of some takes."""
    return [TakeSpec("procedural", "panels-0", 1, seed) for seed in range(count)]


def produce_missing(place: str, count: int, environment: Mapping[str, str]) -> None:
    """What a process does that may be killed: what the store lacks, from the start."""
    os.environ |= environment
    store = TakeStore(place)
    produce(missing_takes(plan(count), store), store, StubStudio(), report=lambda event: None)
