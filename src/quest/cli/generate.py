"""``quest generate``: simulated takes with ground truth, into a take store."""

from __future__ import annotations

import dataclasses
import shlex
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from quest.errors import ConfigError, ObjectError

if TYPE_CHECKING:
    from quest.data.store import TakeStore
    from quest.sim.plan import ObjectShelf, TakeSpec
    from quest.sim.renderer import Renderer
    from quest.sim.staging import TakeSettings
    from quest.sim.suites import Suite


@dataclass(frozen=True)
class Generate:
    """Render takes of articulated objects, with ground truth, into a take store; run again to resume."""

    out: Path
    """Folder of the take store; takes that it already has are skipped."""
    objects: tuple[str, ...] = ()
    """Objects by name: partnet:44817,23724 or procedural:chest-12."""
    split: Literal["train", "validation", "test"] | None = None
    """All PartNet-Mobility objects of a part of the split; also where --procedural takes its seeds from."""
    procedural: int = 0
    """How many procedural objects."""
    seeds: str | None = None
    """Object seeds A..B (both included) of the procedural objects, instead of the first ones of the split's part."""
    partnet: bool = True
    """Whether --split brings PartNet-Mobility objects; --no-partnet for procedural ones only."""
    objects_root: Path | None = None
    """Folder of PartNet-Mobility folders; default: the environment variable QUEST_OBJECTS."""
    suite: Literal["occlusion", "lockers"] | None = None
    """Takes that are hard in one way: something hides a moving entity, also before banks of sixteen like doors."""
    hidden: int | None = None
    """Frames for which a suite's entities are hidden, 10 to 120; default: drawn, and 30 before lockers."""
    look_alike: bool = False
    """Suite occlusion: entities of the same label stay in view; without it, none is ever in view."""
    level: tuple[int, ...] = ()
    """How many joints move one after the other: one level or several; default: 1, before lockers 4."""
    takes_per_object: int = 1
    """Takes of every object and level."""
    seed: int = 0
    """Seed of the first take of each object; the others count up."""
    every: int = 1
    """Keep every n-th frame of the motion script (1 to 8)."""
    views: int | None = None
    """Cameras per take; default: 3, in suites 1."""
    size: int = 224
    """Width and height of the images, pixels."""
    frames_per_joint: int = 60
    """Frames of the motion script that each joint gets."""
    randomize_materials: bool = True
    """Give objects random materials: procedural ones always, others now and then."""

    def run(self) -> int:
        """Render and write; 0 if every planned take is there or was skipped for a stated reason.

        Raises:
            ObjectError: there is no folder of objects to take the named ones from, or not one planned take can be made.
        """
        from quest.data.provenance import code_commit, package_versions
        from quest.data.store import TakeStore
        from quest.sim.objects import find_objects
        from quest.sim.plan import ObjectShelf, plan_takes
        from quest.sim.renderer import Renderer
        from quest.sim.staging import TakeSettings

        suite = self._suite()
        views = self.views if self.views is not None else 3 if suite is None else 1
        settings = TakeSettings(views, self.size, self.every, self.frames_per_joint, self.randomize_materials)
        levels = self.level or (1 if suite is None else suite.level,)
        if self.takes_per_object < 1 or min(levels) < 1:
            raise ConfigError("generate: expected --takes-per-object and --level of at least 1")
        store = TakeStore(self.out)
        takes = plan_takes(
            self._chosen(suite),
            levels=levels,
            takes_per_object=self.takes_per_object,
            first_seed=self.seed,
            suite=suite,
        )
        console = Console(stderr=True, highlight=False)
        missing = [spec for spec in takes if spec.name not in store]
        console.print(
            f"{len(takes)} takes planned, {len(takes) - len(missing)} there already; store {escape(str(self.out))}"
        )
        if not missing:
            return 0
        if any(spec.source == "partnet" for spec in missing):
            find_objects(self.objects_root)  # told before the renderer warms up
        renderer = Renderer()
        provenance = {
            "commit": code_commit(),
            "versions": package_versions(),
            "renderer": str(renderer.device),
            "command": self.command_line(),
        }
        with ObjectShelf(self.objects_root) as shelf:
            skipped = _Run(store, shelf, renderer, settings, provenance, console).make(missing)
        if skipped == len(takes):
            raise ObjectError(f"generate: none of the {skipped} planned takes can be made, for the reasons above")
        return 0

    def command_line(self) -> str:
        """The command that makes these takes again, whichever way this one was called."""
        words = ["quest", "generate"]
        for field in dataclasses.fields(self):
            value, flag = getattr(self, field.name), "--" + field.name.replace("_", "-")
            if value == field.default:
                continue
            if isinstance(value, bool):
                words.append(flag if value else flag.replace("--", "--no-", 1))
            else:
                words += [flag, *(map(str, value) if isinstance(value, tuple) else [str(value)])]
        return shlex.join(words)

    def _suite(self) -> Suite | None:
        """The suite that the arguments name, or None."""
        from quest.sim.suites import SUITES

        if self.suite is None:
            if self.hidden is not None or self.look_alike:
                raise ConfigError("generate: --hidden and --look-alike belong to --suite, and none is given")
            return None
        preset = SUITES[self.suite]
        if self.look_alike and preset.look_alike:
            raise ConfigError(f"generate: suite {self.suite} always has look-alikes; leave --look-alike away")
        if self.frames_per_joint != Generate.frames_per_joint:
            raise ConfigError(f"generate: suite {self.suite} has a script of its own; leave --frames-per-joint away")
        if self.views not in (None, 1):
            raise ConfigError(
                f"generate: suite {self.suite} expects 1 view, for an occluder hides from one camera; leave --views"
            )
        hidden = preset.hidden if self.hidden is None else self.hidden
        return dataclasses.replace(preset, hidden=hidden, look_alike=preset.look_alike or self.look_alike)

    def _chosen(self, suite: Suite | None) -> list[tuple[str, str]]:
        """Source and id of every object that the arguments name."""
        from quest.data.split import object_split
        from quest.sim.plan import parse_object, procedural_objects

        chosen = [pair for text in self.objects for pair in parse_object(text)]
        split = object_split()
        category = None if suite is None else suite.category
        if self.split is not None and self.partnet and category is None:
            chosen += [("partnet", object_id) for object_id in split.partnet_mobility[self.split]]
        if self.procedural or self.seeds:
            first, last = _seed_range(self.seeds) if self.seeds else split.procedural_seeds[self.split or "train"]
            count = self.procedural or last - first + 1
            if count > last - first + 1:
                raise ConfigError(f"generate: {count} procedural objects do not fit into seeds {first}..{last}")
            chosen += procedural_objects(count, first, category)
        if not chosen:
            raise ConfigError("generate: no objects; pass --objects, --split or --procedural")
        other = [name for _, name in chosen if category is not None and name.rpartition("-")[0] != category]
        if other:
            raise ConfigError(
                f"generate: suite {self.suite} expects objects procedural:{category}-SEED, got {', '.join(other)}; "
                "name others, or pass --procedural N"
            )
        return chosen


def _seed_range(text: str) -> tuple[int, int]:
    first, dots, last = text.partition("..")
    if not (dots and first.isdigit() and last.isdigit() and int(first) <= int(last)):
        raise ConfigError(f"generate: expected --seeds A..B with 0 <= A <= B, got {text!r}")
    return int(first), int(last)


@dataclass
class _Run:
    """Makes takes one after the other and shows how far it is."""

    store: TakeStore
    shelf: ObjectShelf
    renderer: Renderer
    settings: TakeSettings
    provenance: dict
    console: Console

    def make(self, takes: list[TakeSpec]) -> int:
        """Make takes; returns how many were skipped."""
        columns = (
            TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[speed]}"),
            TimeElapsedColumn(), TimeRemainingColumn(),
        )  # fmt: skip
        frames, skipped, seconds = 0, 0, 0.0
        warned: set[str] = set()
        with Progress(*columns, console=self.console) as progress:
            bar = progress.add_task("warming up (shaders)", total=len(takes), speed="")
            for index, spec in enumerate(takes):
                start = time.perf_counter()
                made = self._make_one(spec, warned)
                if made == 0:
                    skipped += 1
                elif index:  # the first take pays for the shaders
                    frames, seconds = frames + made, seconds + time.perf_counter() - start
                speed = f"{frames / seconds:.1f} frames/s" if seconds else ""
                progress.update(bar, advance=1, description=spec.name, speed=speed)
        speed = f" at {frames / seconds:.1f} frames/s" if seconds else ""
        self.console.print(f"{len(takes) - skipped} takes written{speed}, {skipped} skipped; store {self.store.root}")
        return skipped

    def _make_one(self, spec: TakeSpec, warned: set[str]) -> int:
        """Number of frames rendered, all views counted; 0 if the take is impossible, which is said once per reason."""
        from quest.sim.generate import generate_take

        try:
            sim_object = self.shelf.load(spec.source, spec.object_id)
            self._warn(spec.object_id, sim_object.warnings, warned)
            take = generate_take(
                sim_object,
                spec.level,
                spec.seed,
                renderer=self.renderer,
                settings=self.settings,
                suite=spec.suite,
                provenance=self.provenance,
            )
        except ObjectError as error:
            self._warn(f"skipped {spec.object_id}", (str(error),), warned)
            return 0
        self.store.write(take)
        return len(take) * len(take.views)

    def _warn(self, subject: str, messages: tuple[str, ...], warned: set[str]) -> None:
        for message in messages:
            line = f"{subject}: {message}"
            if line not in warned:
                warned.add(line)
                self.console.print(f"[yellow]{escape(line)}[/]")
