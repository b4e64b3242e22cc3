"""``quest generate``: simulated takes with ground truth, into a take store."""

from __future__ import annotations

import dataclasses
import shlex
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from quest.cli.console import Console, words_of
from quest.cli.progress import Report, counting
from quest.data.split import object_split
from quest.data.store import TakeStore
from quest.errors import ConfigError, ObjectError
from quest.sim.cameras import CAMERA_MOTIONS, MIXED
from quest.wording import counted

if TYPE_CHECKING:
    from quest.sim.production import Event
    from quest.sim.settings import TakeSettings
    from quest.sim.suites import Suite

    CameraMotion = str
else:
    CameraMotion = tyro.extras.literal_type_from_choices((*CAMERA_MOTIONS, MIXED))

_LEAST_S = 5.0
"""Less says nothing of the speed: takes are written while the next ones are rendered, so two may end together."""
FRAMES_WITH_PULLER = 90
"""Frames that each joint gets if a gripper or a hand has to come and go."""


@dataclass(frozen=True)
class Generate:
    """Render takes of articulated objects, with ground truth, into a take store; run again to resume."""

    out: str
    """Take store, a folder or a URL such as s3://bucket/takes; takes that it already has are skipped."""
    objects: tuple[str, ...] = ()
    """Objects by name, partnet:44817,23724 or procedural:chest-12, or the path of your own folder or URDF."""
    split: Literal["train", "validation", "test"] | None = None
    """All PartNet-Mobility objects of a part of the split; also where --procedural takes its seeds from."""
    procedural: int = 0
    """How many procedural objects."""
    seeds: str | None = None
    """Object seeds A..B (both included) of the procedural objects, instead of the first ones of the split's part."""
    imported: Path | None = None
    """Folder of quest objects import: --split brings its objects too."""
    partnet: bool = True
    """Whether --split brings PartNet-Mobility objects; --no-partnet for procedural ones only."""
    objects_root: Path | None = None
    """Folder of PartNet-Mobility folders; default: the environment variable QUEST_OBJECTS."""
    mix: Literal["usual", "broad"] = "usual"
    """Kinds of procedural objects, and materials of all: the usual furniture and appliances, or everything there is."""
    suite: (
        Literal["occlusion", "lockers", "noise", "shift", "moving", "gripper", "hands", "kitchen", "long", "published"]
        | None
    ) = None
    """Takes that are hard in one way: a named preset of the options below. docs/simulator.md describes each."""
    variant: tuple[str, ...] = ()
    """Kinds of a suite, such as blur and bump of shift; default: all of them."""
    hidden: int | None = None
    """Frames for which a suite's entities are occluded, 10 to 120; default: drawn, and 30 before lockers."""
    look_alike: bool = False
    """Suite occlusion: entities of the same label stay in view; without it, none is ever in view."""
    level: tuple[int, ...] = ()
    """How many joints move one after the other: one level or several; default: 1, before lockers 4."""
    takes_per_object: int = 1
    """Takes of every object and level."""
    seed: int = 0
    """Seed of the first take of each object; the others count up."""
    every: int | None = None
    """Keep every n-th frame of the motion script (1 to 8); default: 1."""
    views: int | None = None
    """Cameras per take; default: 3, in suites 1."""
    size: tuple[int, ...] = ()
    """Width and height of the images, pixels, or one number for square ones; default: 224."""
    frames_per_joint: int | None = None
    """Frames of the motion script that each joint gets; default: 60, with a gripper or a hand 90."""
    frames: int | None = None
    """Frames in which the joints open and close again and again; default: each once, in suite long 10000."""
    camera: CameraMotion | None = None
    """How cameras move; default: static."""
    azimuth: tuple[float, float] | None = None
    """Least and greatest direction of the first camera pose, degrees: 0 is the front; default: -60 60."""
    elevation: tuple[float, float] | None = None
    """The same of its height above the horizon, degrees; default: 5 50, for objects that lie flat 20 65."""
    motion: Literal["human", "robot", "creep", "mixed"] | None = None
    """How joints move: eased with stops and reversals, at constant speeds, slowly, or one of these; default: human."""
    overlap: float | None = None
    """Share of a joint's time in which the next one moves already, 0 to 0.9; default: 0."""
    sensor: Literal["ideal", "structured-light", "stereo"] | None = None
    """Whose depth it is: as rendered, or with the holes, noise and steps of a real sensor; default: ideal."""
    physics: bool = False
    """Drive the joints through a physics engine: friction, damping, inertia."""
    gripper: bool = False
    """A gripper comes and pulls the parts that move."""
    hand: bool = False
    """A person's hand comes and pulls the parts that move."""
    room: bool = False
    """Put the object into a room, among other furniture."""
    things: str | None = None
    """Folder of things to put on the furniture of rooms, as quest objects import makes them; default: plain ones."""
    randomize_materials: bool = True
    """Give objects random materials: procedural ones always, others now and then."""
    stretch: float = 1.0
    """Stretch the object anew in every take, its depth, width and height by up to this factor; 1 leaves it as it is."""
    ray: str | None = None
    """Make the takes on a Ray cluster: its address, auto, or local for one on this machine."""
    ray_cpus_per_worker: int = 2
    """Processor cores that each worker of the cluster claims."""

    def run(self) -> int:
        """Render and write; 0 if every planned take is there or was skipped for a stated reason."""
        from quest.sim.cluster import ClusterSettings, produce_on_cluster
        from quest.sim.plan import plan_takes
        from quest.sim.production import Studio, missing_takes, produce
        from quest.sim.settings import TakeSettings

        suites = self._suites()
        levels = self.level or (suites[0].level if suites else 1,)
        if self.takes_per_object < 1 or min(levels) < 1 or self.seed < 0:
            raise ConfigError("generate: expected --takes-per-object, --level of at least 1, --seed of at least 0")
        store = TakeStore(self.out)
        takes = plan_takes(
            self._chosen(suites[0].category if suites else None),
            levels=levels,
            takes_per_object=self.takes_per_object,
            first_seed=self.seed,
            settings=TakeSettings() if suites else self._settings(TakeSettings()),
            suites=suites,
        )
        console = Console(stderr=True, soft_wrap=False)
        missing = missing_takes(takes, store)
        console.print(
            f"{counted(len(takes), 'take')} planned, {len(takes) - len(missing)} there already; store {self.out}"
        )
        if not missing:
            return 0
        studio = Studio(self.objects_root, self.command_line())
        with counting(console, "rendering", len(missing), "takes") as report:
            made = _Made(console, report)
            try:
                if self.ray is None:
                    produce(missing, store, studio, report=made)
                else:
                    cluster = ClusterSettings(self.ray, self.ray_cpus_per_worker)
                    produce_on_cluster(missing, store, studio, cluster, report=made)
            finally:
                if made.takes or made.skipped:
                    console.print(f"{made}; store {store.url}", soft_wrap=True)
        if made.skipped == len(takes):
            raise ObjectError(f"generate: no planned take can be made ({len(takes)} skipped), for the reasons above")
        return 0

    def command_line(self) -> str:
        """The command that makes these takes again, whichever way this one was called."""
        return shlex.join(["quest", "generate", *words_of(self)])

    def _suites(self) -> tuple[Suite, ...]:
        """The suites that the arguments name, with the changes of the arguments; none for ordinary takes."""
        from quest.sim.suites import find_suites

        if self.suite is None:
            if self.hidden is not None or self.look_alike or self.variant:
                raise ConfigError("generate: --hidden, --look-alike and --variant belong to --suite, and none is given")
            return ()
        suites = [s.hidden_for(self.hidden, look_alike=self.look_alike) for s in find_suites(self.suite, self.variant)]
        if suites[0].hiding is not None and self.frames_per_joint is not None:
            raise ConfigError(f"generate: suite {self.suite} has a script of its own; omit --frames-per-joint")
        return tuple(dataclasses.replace(suite, settings=self._settings(suite.settings)) for suite in suites)

    def _settings(self, preset: TakeSettings) -> TakeSettings:
        """A preset with the changes of the arguments."""
        from quest.sim.sensor import SENSORS

        pulled = (self.gripper or self.hand) and not preset.pulled and self.frames_per_joint is None
        cameras = _given(motion=self.camera, azimuth_deg=self.azimuth, elevation_deg=self.elevation)
        motion = _given(kind=self.motion, overlap=self.overlap)
        return dataclasses.replace(
            preset,
            cameras=dataclasses.replace(preset.cameras, **cameras),
            motion=dataclasses.replace(preset.motion, **motion),
            physics=preset.physics or self.physics,
            gripper=preset.gripper or self.gripper,
            hand=preset.hand or self.hand,
            room=preset.room or self.room,
            things=self.things,
            randomize_materials=preset.randomize_materials and self.randomize_materials,
            stretch=self.stretch,
            broad_materials=self.mix == "broad",
            **_given(
                views=self.views,
                every=self.every,
                frames=self.frames,
                frames_per_joint=FRAMES_WITH_PULLER if pulled else self.frames_per_joint,
                size=self._size(),
                sensor=None if self.sensor is None else SENSORS[self.sensor],
            ),
        )

    def _size(self) -> int | tuple[int, int] | None:
        """Side of square images, or width and height."""
        if len(self.size) > 2:
            raise ConfigError(f"generate: expected --size SIDE or --size WIDTH HEIGHT, got {len(self.size)} numbers")
        if len(self.size) == 2 and self.size[0] != self.size[1]:
            return self.size[0], self.size[1]
        return self.size[0] if self.size else None

    def _chosen(self, category: str | None) -> list[tuple[str, str]]:
        """Source and id of every object that the arguments name; all of a category if that is given."""
        from quest.sim.plan import imported_objects, parse_object, procedural_objects

        chosen = [pair for text in self.objects for pair in parse_object(text)]
        split = object_split()
        if self.split is not None and self.partnet and category is None:
            chosen += [("partnet", object_id) for object_id in split.partnet_mobility[self.split]]
        if self.imported is not None and self.split is None:
            raise ConfigError("generate: --imported goes with --split; name single objects by --objects FOLDER/NAME")
        if self.imported is not None and self.split is not None and category is None:
            chosen += imported_objects(self.imported, self.split)
        if self.procedural < 0:
            raise ConfigError(f"generate: expected --procedural of at least 0, got {self.procedural}")
        if self.procedural or self.seeds:
            first, last = _seed_range(self.seeds) if self.seeds else split.procedural_seeds[self.split or "train"]
            if self.seeds and self.split is not None:
                low, high = split.procedural_seeds[self.split]
                if not low <= first <= last <= high:
                    raise ConfigError(
                        f"generate: --seeds {self.seeds} are not {self.split} seeds, which are {low}..{high}; name "
                        "such, or omit --split"
                    )
            count = self.procedural or last - first + 1
            if count > last - first + 1:
                raise ConfigError(
                    f"generate: {counted(count, 'procedural object')} do not fit into seeds {first}..{last}"
                )
            chosen += procedural_objects(count, first, category, mix=self.mix)
        if not chosen:
            raise ConfigError("generate: no objects; pass --objects, --split or --procedural")
        other = [name for _, name in chosen if category is not None and name.rpartition("-")[0] != category]
        if other:
            raise ConfigError(
                f"generate: suite {self.suite} expects objects procedural:{category}-SEED, got {', '.join(other)}; "
                "name others, or pass --procedural N"
            )
        return chosen


def _given(**values: Any) -> dict[str, Any]:
    """What is not None."""
    return {name: value for name, value in values.items() if value is not None}


def _seed_range(text: str) -> tuple[int, int]:
    first, dots, last = text.partition("..")
    last = last if dots else first
    if not (first.isdecimal() and last.isdecimal() and int(first) <= int(last)):
        raise ConfigError(f"generate: expected --seeds A..B, or one seed, with 0 <= A <= B, got {text!r}")
    return int(first), int(last)


class _Made:
    """Counts the takes of a production on a bar, and says each warning once."""

    def __init__(self, console: Console, report: Report) -> None:
        self.takes = self.skipped = 0
        self._console, self._report = console, report
        self._said: set[str] = set()
        self._frames, self._first_s, self._last_s = 0, 0.0, 0.0

    def __call__(self, event: Event) -> None:
        """Show an event."""
        from quest.sim.production import Notice, TakeMade

        if isinstance(event, Notice):
            self._warn(event.text)
            return
        if isinstance(event, TakeMade):
            self.takes, self._last_s = self.takes + 1, time.perf_counter()
            if self.takes == 1:  # the first take pays for the shaders
                self._first_s = self._last_s
            else:
                self._frames += event.frames
            for warning in event.warnings:
                self._warn(f"{event.spec.object_id}: {warning}")
        else:
            self.skipped += 1
            self._warn(f"skipped {event.spec.object_id}: {event.reason}")
        self._report(self.takes + self.skipped)

    def __str__(self) -> str:
        took_s = self._last_s - self._first_s
        speed = f" at {self._frames / took_s:.1f} frames/s" if took_s >= _LEAST_S else ""
        return f"{counted(self.takes, 'take')} written{speed}, {self.skipped} skipped"

    def _warn(self, line: str) -> None:
        if line not in self._said:
            self._said.add(line)
            self._console.print(line, style="yellow")
