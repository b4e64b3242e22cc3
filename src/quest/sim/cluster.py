"""Making many takes on many machines: the studios of :mod:`quest.sim.production`, each an actor of a Ray cluster.

A worker lives as long as the production, for a renderer is costly to set up. It gets two takes at a time and makes one
while it writes the other. When it dies, its takes are made again by others; a take that kills every worker it
comes to is given up. Nothing depends on which worker makes a take, nor on how many there are.
"""

from __future__ import annotations

import os
import socket
import time
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from quest.data.store import TakeStore
from quest.errors import ConfigError, ObjectError, QuestError, RendererError
from quest.extras import require
from quest.sim.production import Event, Notice, Report, Studio, TakeMade, TakeSkipped, write_once

if TYPE_CHECKING:
    from types import ModuleType

    from quest.sim.plan import TakeSpec

_AT_A_TIME = 2
"""Takes that a worker has: one that it makes, one that it writes."""
_ATTEMPTS = 4
"""How many workers may die over a take."""
_FAILED_OPENINGS = 3
"""How many workers in a row may die before they have made anything."""
_PATIENCE_S = 60.0
_CONNECT_S = 10.0


@dataclass(frozen=True)
class ClusterSettings:
    """Where to work, and how much of it to take."""

    address: str = "auto"
    """Of the cluster's head, ``auto`` for the one that this machine belongs to, or ``local`` for a cluster on this
    machine alone that ends with the production."""
    cpus_per_worker: int = 2
    """Processor cores that a worker claims. A node gets as many workers as it has room for."""

    def __post_init__(self) -> None:
        if self.cpus_per_worker < 1:
            raise ConfigError(f"cluster: expected at least 1 core per worker, got {self.cpus_per_worker}")


def produce_on_cluster(
    specs: Sequence[TakeSpec], store: TakeStore, studio: Studio, cluster: ClusterSettings, *, report: Report
) -> None:
    """Makes takes on the workers of a Ray cluster, which write them into a store.

    Every worker must reach the store by the same name: a folder on a file system that all nodes share, or an object
    store. Interrupted, it kills its workers; the store never has a part of a take. Takes that the store has meanwhile
    are left alone. Every worker opens a copy of the studio. ``report`` is told of every take when it is in the store or
    cannot be made, and of workers that died.

    Raises:
        ConfigError: there is no such cluster, or workers cannot reach the store.
        ObjectError, RendererError: a worker cannot be set up, and the message names its node; or a take killed all
            workers that tried to make it.
        TakeError: a worker cannot write into the store.
    """
    if store.url.startswith("memory:"):
        raise ConfigError(f"store {store.url}: workers of a cluster cannot reach this process's memory; give another")
    ray = require("ray")
    with connected(ray, cluster):
        crew = _Crew(ray, list(specs), store, studio, cluster, report)
        try:
            crew.work()
        finally:
            crew.dismiss()


@contextmanager
def connected(ray: ModuleType, cluster: ClusterSettings) -> Iterator[None]:
    """Within a cluster: the one that this process is connected to already, or the named one."""
    if ray.is_initialized():
        yield
        return
    host, colon, port = cluster.address.rpartition(":")
    if colon and port.isdecimal() and "/" not in host:  # Ray itself would try for half a minute
        try:
            socket.create_connection((host, int(port)), timeout=_CONNECT_S).close()
        except OSError as error:
            raise _unreachable(cluster, error) from error
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Ray would report to its makers
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": "error"}
    if cluster.address == "local":
        options |= {"include_dashboard": False, "num_cpus": max(os.cpu_count() or 1, cluster.cpus_per_worker)}
    try:
        ray.init(address=cluster.address, **options)
    except (ConnectionError, ValueError, RuntimeError, TimeoutError) as error:
        raise _unreachable(cluster, error) from error
    try:
        yield
    finally:
        ray.shutdown()


def _unreachable(cluster: ClusterSettings, error: Exception) -> ConfigError:
    reason = str(error).partition("\n")[0]
    return ConfigError(
        f"cluster {cluster.address!r}: cannot be reached ({reason}); expected HOST:PORT of its head, auto on a machine "
        "that belongs to one, or local"
    )


class Worker:
    """What lives on a node: a studio in a thread of its own, and what it has made is written beside it."""

    def __init__(self, store: str, studio: Studio, specs: Sequence[TakeSpec]) -> None:
        self._node = f"{socket.gethostname()}/{require('ray').get_runtime_context().get_node_id()[:8]}"
        self._store, self._studio, self._specs = store, studio, specs
        self._making = ThreadPoolExecutor(1, thread_name_prefix="quest-make")

    def open(self) -> tuple[str, dict[str, Any]]:
        """Sets the studio up; the node, and what takes made here depend on.

        Raises:
            QuestError: it cannot be set up; the message names the node.
        """
        with _named(self._node):
            self._takes = TakeStore(self._store)
            self._making.submit(self._studio.open, self._specs, complete=True).result()
            return self._node, self._studio.describe()

    def make(self, spec: TakeSpec) -> Event:
        """Makes a take and writes it.

        Raises:
            QuestError: the renderer broke or the store cannot be written; the message names the node.
        """
        with _named(self._node):
            if spec.name in self._takes:  # its maker died between writing and saying so
                header = self._takes.header(spec.name)
                return TakeMade(spec, header.frames * len(header.cameras), 0.0, node=self._node)
            start = time.perf_counter()
            try:
                take, warnings = self._making.submit(self._studio.make, spec).result()
            except ObjectError as error:
                return TakeSkipped(spec, str(error))
            made = TakeMade(spec, len(take) * len(take.views), time.perf_counter() - start, warnings, self._node)
            write_once(self._takes, take)
            return made


@contextmanager
def _named(node: str) -> Iterator[None]:
    """Says on which node an error came up."""
    try:
        yield
    except QuestError as error:
        raise type(error)(f"node {node}: {error}") from error


@dataclass(eq=False)
class _Hand:
    """A worker as seen from here."""

    actor: Any
    node: str = "a new worker"
    ready: bool = False
    specs: dict[Any, TakeSpec | None] = field(default_factory=dict)
    """What it has to do, by the promise of its answer; None stands for setting itself up."""


class _Crew:
    """All workers, and what is still to be made."""

    def __init__(
        self,
        ray: ModuleType,
        specs: list[TakeSpec],
        store: TakeStore,
        studio: Studio,
        cluster: ClusterSettings,
        report: Report,
    ) -> None:
        self._ray, self._report, self._cpus = ray, report, cluster.cpus_per_worker
        where = str(store.root.resolve()) if store.is_folder else store.url
        self._arguments = ray.put(where), ray.put(studio), ray.put(specs)
        self._todo = deque(specs)
        self._deaths: Counter[str] = Counter()
        self._failed_openings = 0
        self._hands: list[_Hand] = []
        self._described: tuple[str, dict[str, Any]] | None = None

    def work(self) -> None:
        """Makes everything."""
        waited = False
        while self._todo or self._unfinished():
            self._hire()
            self._assign()
            promises = {promise: hand for hand in self._hands for promise in hand.specs}
            done, _ = self._ray.wait(list(promises), num_returns=1, timeout=_PATIENCE_S)
            for promise in done:
                self._receive(promises[promise], promise)
            if not done and not waited and not any(hand.ready for hand in self._hands):
                waited = True
                self._report(Notice(f"waiting for a node with {self._cpus} free cores; the cluster has none now"))

    def _unfinished(self) -> int:
        """How many takes workers have."""
        return sum(spec is not None for hand in self._hands for spec in hand.specs.values())

    def dismiss(self) -> None:
        """Ends all workers."""
        for hand in self._hands:
            self._ray.kill(hand.actor)

    def _hire(self) -> None:
        """As many workers as there is room for, and takes to make."""
        nodes = [node for node in self._ray.nodes() if node["Alive"]]
        room = sum(int(node["Resources"].get("CPU", 0) // self._cpus) for node in nodes)
        actor = self._ray.remote(num_cpus=self._cpus, max_restarts=0, max_concurrency=_AT_A_TIME)(Worker)
        while len(self._hands) < max(1, min(room, self._unfinished() + len(self._todo))):
            hand = _Hand(actor.remote(*self._arguments))
            hand.specs[hand.actor.open.remote()] = None
            self._hands.append(hand)

    def _assign(self) -> None:
        """Gives takes to workers; those over which a worker died are made alone, so that only the guilty suffer."""
        for load in range(_AT_A_TIME):
            for hand in self._hands:
                if not (self._todo and hand.ready and len(hand.specs) == load):
                    continue
                together = [self._todo[0], *hand.specs.values()]
                if load and any(spec and self._deaths[spec.name] for spec in together):
                    continue
                if load and len(self._todo) <= sum(not hand.ready for hand in self._hands):
                    continue  # for those that are still being set up
                spec = self._todo.popleft()
                hand.specs[hand.actor.make.remote(spec)] = spec

    def _receive(self, hand: _Hand, promise: Any) -> None:
        errors = self._ray.exceptions
        try:
            answer = self._ray.get(promise)
        except errors.RayTaskError as error:
            if isinstance(error.cause, QuestError):
                raise error.cause from error
            raise
        except errors.RayError as error:
            self._bury(hand, error)
            return
        spec = hand.specs.pop(promise)
        if spec is None:
            hand.ready, hand.node = True, answer[0]
            self._failed_openings = 0
            self._compare(*answer)
        else:
            self._report(replace(answer, spec=spec))

    def _bury(self, hand: _Hand, error: Exception) -> None:
        """Puts back what a dead worker had to do.

        Raises:
            RendererError: too many have died over the same.
        """
        self._hands.remove(hand)
        self._ray.kill(hand.actor)  # if it is only out of reach, nobody waits for it any more
        reason = str(error).partition("\n")[0]
        lost = [spec for spec in hand.specs.values() if spec is not None]
        self._report(Notice(f"node {hand.node}: a worker died; {len(lost)} takes are made again by others ({reason})"))
        if not lost:
            self._failed_openings += 1
            if self._failed_openings >= _FAILED_OPENINGS:
                raise RendererError(
                    f"cluster: {_FAILED_OPENINGS} workers in a row died while they were set up, the last with: "
                    f"{reason}; run quest doctor on the nodes"
                )
        for spec in lost:
            self._deaths[spec.name] += 1
            if self._deaths[spec.name] >= _ATTEMPTS:
                raise RendererError(
                    f"take {spec.name!r}: {_ATTEMPTS} workers died over it, the last on node {hand.node} with: "
                    f"{reason}; leave its object away, or look for what kills them (memory?)"
                )
            self._todo.append(spec)

    def _compare(self, node: str, description: dict[str, Any]) -> None:
        """Says where nodes differ in what takes depend on."""
        if self._described is None:
            self._described = node, description
        first, expected = self._described
        different = sorted(key for key in expected if description.get(key) != expected[key])
        if different:
            what = ", ".join(different)
            self._report(Notice(f"node {node} differs from node {first} in {what}; the same seed may give other takes"))
