"""What tables are made of: takes, trained networks and answers, each made once in a folder and found there again.

    work / takes / NAME                      a take store
    work / features, work / encoded          what the frozen encoder says of frames, in training and in evaluation
    work / runs / VARIANT / seed-N           checkpoints and weights of a training
    work / answers / TAKES / ASKED / seed-N  answers to one take each

Everything goes on where it stopped, and what is there is not made again unless what it depends on has changed.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from rich.console import Console
from torch import Tensor

from quest.baselines import TRACKERS, ClipTracker, line_up
from quest.bench.rows import Answers
from quest.bench.settings import Making
from quest.bench.trackers import ChainedFlow, NoisyColours
from quest.bench.training import store_of, train_published, train_rival
from quest.bench.variants import Variant
from quest.data.provenance import code_hash, file_hash, package_versions
from quest.data.split import SplitPart
from quest.data.store import TakeStore
from quest.errors import ConfigError
from quest.evaluation.finished import FinishedTakes, KeptAnswers
from quest.evaluation.runner import evaluate
from quest.evaluation.selection import Shard, select_takes
from quest.extras import require
from quest.model.weights import find_weights, weights_digest
from quest.paper.network import PaperNetwork, read_paper
from quest.paper.tracker import PaperTracker
from quest.sim.cluster import ClusterSettings, connected, produce_on_cluster
from quest.sim.plan import TakeSpec, parse_object, plan_takes, procedural_objects
from quest.sim.production import Notice, Studio, TakeSkipped, missing_takes, produce
from quest.sim.settings import TakeSettings
from quest.sim.suites import Suite, find_suites
from quest.track.tracker import pick_device
from quest.whole_file import whole_file

TakesName = Literal["teach", "choose", "motions", "views", "objects", "hidden", "lockers", "laptops"]

_LAPTOPS, _BANKS = 110_000, 110_100
"""First seeds of test objects."""
_PARTS: tuple[SplitPart, ...] = ("train", "validation", "test", "unlisted")
_PARTS_ON_CLUSTER = 8
"""Of the answers of everybody to a set of takes, done side by side."""


@dataclass(frozen=True)
class Asked:
    """Who answers, as one row of a table calls it."""

    label: str
    tracker: str = ""
    """One of :data:`quest.baselines.TRACKERS`; empty for a published network, or for the chained true flow."""
    variant: Variant | None = None
    """The published network that answers."""
    persistent: bool = True
    """Whether a query keeps its slot."""
    flow_noise: float | None = None
    """Noise of the true flow that is chained, half diagonals."""
    noise: float = 0.0
    """Of colours, as a share of their range."""
    reference: str | None = None
    """Label of the row that it is compared with; None for the reference."""

    @property
    def is_trained(self) -> bool:
        """Whether something has to be trained that answers."""
        return self.variant is not None or (self.tracker in TRACKERS and TRACKERS[self.tracker].retrained)

    @property
    def is_seeded(self) -> bool:
        """Whether it answers otherwise for every seed."""
        return self.is_trained or self.flow_noise is not None

    @property
    def key(self) -> str:
        """Of its folder."""
        who = self.tracker or (self.variant.name if self.variant else f"flow-{self.flow_noise:g}")
        return f"{who}{'' if self.persistent else '-anew'}{f'-noise-{self.noise:g}' if self.noise else ''}"


@dataclass(frozen=True)
class Workbench:
    """Makes what is missing."""

    making: Making
    console: Console

    def answers(self, asked: Sequence[Asked], takes: TakesName, levels: Sequence[int] = ()) -> list[Answers]:
        """The answers of everybody to takes, of every seed where something was trained."""
        levels, store = tuple(levels or self.making.levels), self.takes(takes)
        known = sorted({info.level for info in store.infos().values()})
        levels = tuple(level for level in levels if level in known)
        trained = {a.variant.name if a.variant else a.tracker: a for a in asked if a.is_trained}
        if trained:
            for name in ("teach", "choose"):
                self.takes(name)
            self._each(_train, [(self.making, a, seed) for a in trained.values() for seed in self.making.seeds])
        jobs = [(a, seed) for a in asked for seed in (self.making.seeds if a.is_seeded else (0,))]
        parts = 1 if self.making.ray is None else _PARTS_ON_CLUSTER
        shards = [Shard(i, parts) for i in range(parts)]
        self._each(_answer, [(self.making, a, takes, levels, seed, shard) for a, seed in jobs for shard in shards])
        return [_answer(self.making, a, takes, levels, seed, Shard()) for a, seed in jobs]

    def takes(self, name: TakesName) -> TakeStore:
        """A store that has all takes of a name, but for those that an object has too few joints for.

        Raises:
            ConfigError: to learn from, it has others as well.
        """
        store, specs = store_of(self.making, name), planned(self.making, name)
        missing, others = missing_takes(specs, store), {*store.names()} - {spec.name for spec in specs}
        if others and name in ("teach", "choose"):
            raise ConfigError(f"{store.url}: {min(others)} was made for other settings; use another --work")
        if not missing:
            return store
        self.console.print(f"takes {name}: {len(missing)} of {len(specs)} are to be rendered")
        studio = Studio(self.making.objects_root, f"quest bench (takes {name})")

        def told(event: object) -> None:
            if isinstance(event, Notice | TakeSkipped):
                text = event.text if isinstance(event, Notice) else f"skipped {event.spec.name}: {event.reason}"
                self.console.print(f"  {text}", highlight=False, markup=False)

        if self.making.ray is None:
            produce(missing, store, studio, report=told)
        else:
            produce_on_cluster(missing, store, studio, ClusterSettings(self.making.ray), report=told)
        return store

    def kept(self, asked: Asked, takes: TakesName, seed: int) -> KeptAnswers:
        """Where anything is kept that somebody answered to takes."""
        return KeptAnswers(**_place(self.making, asked, takes, seed))

    def _each(self, job: Callable[..., Any], arguments: Iterable[tuple]) -> None:
        """Do a job with each of some arguments, here one after the other, or on a cluster side by side."""
        if self.making.ray is None:
            for each in arguments:
                self.console.print(_words(job, each), highlight=False)
                job(*each)
            return
        ray, jobs = require("ray"), list(arguments)
        with connected(ray, ClusterSettings(self.making.ray)):
            remote = ray.remote(job)
            for words in dict.fromkeys(_words(job, each) for each in jobs):
                self.console.print(words, highlight=False)
            ray.get([remote.remote(*each) for each in jobs])


def _words(job: Callable[..., Any], arguments: tuple) -> str:
    told = [a for a in arguments[1:] if not isinstance(a, Shard)]
    return " ".join([job.__name__.strip("_"), *(str(getattr(a, "key", getattr(a, "name", a))) for a in told)])


def planned(making: Making, name: TakesName) -> list[TakeSpec]:
    """The takes of a name.

    - ``teach``, ``choose`` (every fourth frame), ``motions``: as published, one rig of cameras for each object, in its
      own materials; each with motions of its own;
    - ``views``: the same objects from other cameras, in other light;
    - ``objects``: test objects, filmed as published;
    - ``hidden``, ``lockers``: occluded for 60 frames, alone and beside look-alikes; banks of like doors;
    - ``laptops``: both rims of a closed laptop.
    """
    taught, new = ([pair for text in texts for pair in parse_object(text)] for texts in (making.taught, making.new))
    (rig,) = find_suites("published")

    def plan(
        objects: Sequence[tuple[str, str]],
        *suites: Suite,
        levels: tuple[int, ...] = making.levels,
        each: int = 1,
        first_seed: int = 0,
        settings: TakeSettings = TakeSettings(),
    ) -> list[TakeSpec]:
        return plan_takes(
            objects, levels=levels, takes_per_object=each, first_seed=first_seed, settings=settings, suites=suites
        )

    def filmed(**changes: Any) -> Suite:
        return replace(rig, settings=replace(rig.settings, **changes))

    match name:
        case "teach":
            return plan(taught, filmed(every=4), levels=making.teach_levels, each=making.takes_per_object)
        case "choose":
            return plan(taught, filmed(every=4), levels=(1,), first_seed=1000)
        case "motions":
            return plan(taught, filmed(views=making.views), first_seed=2000)
        case "views":
            return plan(taught, first_seed=3000, settings=TakeSettings(views=making.views, randomize_materials=False))
        case "objects":
            return plan(new, filmed(views=making.views), first_seed=2000)
        case "hidden":
            (hiding,) = find_suites("occlusion")
            return plan(new, *(hiding.hidden_for(60, look_alike=alike) for alike in (False, True)), levels=(1,))
        case "lockers":
            return plan(procedural_objects(len(new), _BANKS, "locker_bank"), *find_suites("lockers"), levels=(4,))
        case "laptops":
            return plan(procedural_objects(2 * len(new), _LAPTOPS, "laptop"), levels=(1,))


def _train(making: Making, asked: Asked, seed: int) -> Path:
    """The weights of who answers, which are trained if they are not there."""
    if asked.variant is not None:
        return train_published(making, asked.variant, seed)
    return train_rival(making, asked.tracker, seed)


def _answer(
    making: Making, asked: Asked, takes: TakesName, levels: tuple[int, ...], seed: int, shard: Shard
) -> Answers:
    """Everybody's answers to takes, as far as they are in a shard."""
    store, tracker = store_of(making, takes), _Late(making, asked, seed)
    finished = FinishedTakes(**_place(making, asked, takes, seed))
    wanted = {spec.name for spec in planned(making, takes)}
    infos = {name: info for name, info in store.infos().items() if name in wanted}
    chosen = select_takes(infos, split=_PARTS, levels=levels)
    found = evaluate(store, chosen, [tracker], finished=finished, shard=shard)
    records = tuple(replace(r, subject=replace(r.subject, tracker=asked.label)) for r in found.records)
    return Answers(asked.label, seed, records, reference=asked.reference)


def _place(making: Making, asked: Asked, takes: TakesName, seed: int) -> dict[str, Any]:
    """The folder of somebody's answers to takes, and a digest of what they depend on beside the takes."""
    made_by: list[object] = [code_hash(), package_versions()]
    if asked.is_trained:
        made_by.append(file_hash(_train(making, asked, seed)))
    elif asked.tracker:
        made_by += [making.weights, file_hash(find_weights(making.weights)), str(making.rivals)]
    digest = hashlib.sha256(repr([*made_by, asked.key, seed]).encode()).hexdigest()
    return {"folder": making.work / "answers" / takes / asked.key / f"seed-{seed}", "made_by": digest}


@dataclass(frozen=True)
class _Late:
    """A tracker that is made when it is first asked: where all answers are kept, none is."""

    making: Making
    asked: Asked
    seed: int
    protocols = ("point",)

    @property
    def name(self) -> str:
        return self.asked.key

    @cached_property
    def tracker(self) -> ClipTracker:
        return build(self.making, self.asked, self.seed)

    def track(self, clip: Any, queries: Any = None) -> Any:
        return self.tracker.track(clip, queries)

    def told(self, take: Any, view: int) -> ClipTracker:
        """The tracker, which knows the truth if it is there to."""
        return self.tracker.told(take, view) if isinstance(self.tracker, ChainedFlow) else self.tracker


def build(making: Making, asked: Asked, seed: int, *, cached: bool = True) -> ClipTracker:
    """Who answers; a published network reads what the encoder has said of frames before if it may."""
    if asked.flow_noise is not None:
        return ChainedFlow(asked.flow_noise, seed)
    tracker: ClipTracker
    if asked.variant is None:
        rivals = _train(making, asked, seed) if asked.is_trained else making.rivals
        (tracker,) = line_up([asked.tracker], weights=making.weights, rivals=rivals)
    else:
        network = read_paper(_train(making, asked, seed)).network
        if cached and not asked.noise:
            serve_cached(network, making.work / "encoded")
        tracker = PaperTracker(network, device=pick_device("auto"), persistent=asked.persistent)
    return NoisyColours(tracker, asked.noise, seed) if asked.noise else tracker


def serve_cached(network: PaperNetwork, root: Path) -> None:
    """Make a network read tokens instead of computing them, as far as they are there.

    Many networks share one frozen encoder. Frames are looked up by their letterboxed colours, and encoded once.
    """
    encode, folder = network.encode, root / weights_digest(network.encoder)[:12]
    folder.mkdir(parents=True, exist_ok=True)

    def read(rgb: Tensor) -> Tensor:
        return torch.stack([one(image) for image in rgb])

    def one(image: Tensor) -> Tensor:
        colours = np.ascontiguousarray(image.cpu().numpy())
        file = folder / f"{hashlib.blake2b(colours.data, digest_size=16).hexdigest()}.npy"
        if not file.exists():
            with whole_file(file) as partial, partial.open("wb") as out:
                np.save(out, encode(image[None])[0].detach().half().cpu().numpy())
        return torch.from_numpy(np.load(file)).to(image.device).float()

    network.encode = read  # type: ignore[method-assign]
