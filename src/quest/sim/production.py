"""Making many takes: what one process does, and what each worker of a cluster does (:mod:`quest.sim.cluster`).

A studio makes one take after the other. While a take is compressed and written in a thread of its own, the studio makes
the next one.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quest.data.provenance import code_commit, package_versions
from quest.data.take_format import hash_take
from quest.errors import ConfigError, ObjectError, TakeError
from quest.sim.generate import generate_take
from quest.sim.objects import find_objects, find_urdf, object_digest
from quest.sim.plan import ObjectShelf, TakeSpec
from quest.sim.renderer import Renderer
from quest.types import Take

if TYPE_CHECKING:
    from quest.data.store import TakeStore

_WAIT_FOR_BYTES = 1 << 30
"""Takes larger than this are written before the next one is begun: two of them would be a lot of memory."""


@dataclass(frozen=True)
class TakeMade:
    """A take is in the store."""

    spec: TakeSpec
    frames: int
    """All views counted."""
    seconds: float
    """How long it took to make, without writing it."""
    warnings: tuple[str, ...] = ()
    """What was found wrong with its object."""
    node: str = ""
    """Which machine made it; empty for this one."""


@dataclass(frozen=True)
class TakeSkipped:
    """A take cannot be made."""

    spec: TakeSpec
    reason: str


@dataclass(frozen=True)
class Notice:
    """Something that a person should know, and that does not stop the production."""

    text: str


Event = TakeMade | TakeSkipped | Notice
Report = Callable[[Event], None]
"""Is told what happens, in the thread that called."""


class Studio:
    """Makes takes, one after the other, in one thread.

    It costs nothing until it is opened; pickled before, it can be opened on another machine.

    Args:
        objects_root: folder of PartNet-Mobility folders; None for the environment's ``QUEST_OBJECTS``.
        command: the command that makes these takes, for their provenance.
    """

    def __init__(self, objects_root: Path | None = None, command: str = "") -> None:
        self.objects_root, self.command = objects_root, command

    def open(self, specs: Sequence[TakeSpec], *, complete: bool = False) -> None:
        """Set up what is costly, so that these takes can be made: a renderer, and a shelf of objects.

        ``complete``: it must have all their objects. Workers of a cluster must, or it would depend on who makes a take
        whether it can be made.

        Raises:
            ObjectError: there is no folder of objects to take the named ones from, or it is to be complete and some
                objects have none here.
            RendererError: nothing can render here.
        """
        wanted = {spec.object_id for spec in specs if spec.source == "partnet"}
        if wanted:  # told before the renderer warms up
            missing = sorted(wanted - {folder.name for folder in find_objects(self.objects_root)})
            if missing and complete:
                raise ObjectError(
                    f"objects {', '.join(missing)}: no such folders in {self.objects_root or 'QUEST_OBJECTS'}; every "
                    "machine needs the folders of all objects"
                )
        if complete:
            for own in {spec.object_id for spec in specs if spec.source == "own"}:
                find_urdf(Path(own))
        self._renderer, self._shelf = Renderer(), ObjectShelf(self.objects_root)
        self._provenance = {**self.describe(), "command": self.command}

    def describe(self) -> dict[str, Any]:
        """What takes depend on beside their specification: commit, versions and renderer."""
        return {"commit": code_commit(), "versions": package_versions(), "renderer": str(self._renderer.device)}

    def make(self, spec: TakeSpec) -> tuple[Take, tuple[str, ...]]:
        """A take, and what was found wrong with its object.

        Raises:
            ConfigError: its suite cannot be made with its settings.
            ObjectError: it cannot be made from this object.
            RendererError: the renderer broke.
        """
        sim_object, provenance = self._shelf.load(spec.source, spec.object_id), self._provenance
        if spec.source == "own":
            provenance = {**provenance, "object": object_digest(Path(spec.object_id))}
        take = generate_take(
            sim_object,
            spec.level,
            spec.seed,
            renderer=self._renderer,
            settings=spec.settings,
            suite=spec.suite,
            provenance=provenance,
        )
        return take, sim_object.warnings


def missing_takes(specs: Iterable[TakeSpec], store: TakeStore) -> list[TakeSpec]:
    """Those takes that the store does not have as a whole, each once.

    Raises:
        ConfigError: two different takes have the same name, as those of objects whose folders have; or the store has
            one that was made with other settings, or of a user's own object that has changed since.
        ObjectError: the URDF of a user's own object is gone.
    """
    wanted: dict[str, TakeSpec] = {}
    for spec in specs:
        if wanted.setdefault(spec.name, spec) != spec:
            raise ConfigError(
                f"take {spec.name}: it is planned of {wanted[spec.name].object_id} and of {spec.object_id}; rename the "
                "folder of one of them, or use two stores"
            )
    there = store.headers(wanted)
    for name, header in there.items():
        spec, about = wanted[name], header.info.provenance
        own = object_digest(Path(spec.object_id)) if spec.source == "own" else None
        differs = None
        if about.get("settings", spec.settings.digest) != spec.settings.digest:  # older takes do not say
            differs = "other settings"
        elif {"settings", "object"} & about.keys() and about.get("object") != own:
            differs = f"another {spec.object_id}"
        if differs is not None:
            raise ConfigError(
                f"take {name}: {store.url} has it of {differs}, made by `{about.get('command', 'unknown')}`; "
                "use another store, another --seed, or delete it there"
            )
    return [spec for name, spec in wanted.items() if name not in there]


def produce(specs: Sequence[TakeSpec], store: TakeStore, studio: Studio, *, report: Report) -> None:
    """Makes takes one after the other in this process and writes them into a store.

    Interrupted, it finishes the take that is being written; the store never has a part of one.

    Raises:
        ObjectError, RendererError: the studio cannot be opened here.
        TakeError: the store cannot be written.
    """
    studio.open(specs)
    writing: list[tuple[TakeMade, Future[None]]] = []

    def finish() -> None:
        while writing:
            made, written = writing.pop()
            written.result()
            report(made)

    with ThreadPoolExecutor(1, thread_name_prefix="quest-write") as writer:
        try:
            for spec in specs:
                start = time.perf_counter()
                try:
                    take, warnings = studio.make(spec)
                except ObjectError as error:
                    finish()
                    report(TakeSkipped(spec, str(error)))
                    continue
                made = TakeMade(spec, len(take) * len(take.views), time.perf_counter() - start, warnings)
                large = sum(view.clip.rgb.nbytes * 3 for view in take.views) > _WAIT_FOR_BYTES
                finish()
                writing.append((made, writer.submit(write_once, store, take)))
                del take
                if large:
                    finish()
        finally:
            finish()


def write_once(store: TakeStore, take: Take) -> None:
    """Write a take that somebody else may be writing as well: the first one counts, if both made the same.

    Raises:
        TakeError: the store has another take of that name.
    """
    try:
        store.write(take)
    except TakeError as error:
        if take.info.name not in store:
            raise
        if store.data_hash(take.info.name) != hash_take(take):
            raise TakeError(f"{error}; its arrays differ from those made here, so versions or settings do") from error
