"""Teach the shipped weights to find the entities of an object of your own, and see what it was worth on other takes.

    python examples/fine_tune.py                                    # the tool chest in examples/toolbox
    python examples/fine_tune.py --objects path/to/mine --steps 1000

Every step is a `quest` command, which is printed before it runs. Run again, it makes no take and trains no step twice;
settings are chosen and takes are evaluated anew.
"""

from __future__ import annotations

import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console
from rich.table import Table

from quest.evaluation.results import read_results
from quest.evaluation.summary import Row


@dataclass(frozen=True)
class FineTune:
    """Make takes of an object, train on them, compare before and after."""

    objects: tuple[str, ...] = (str(Path(__file__).parent / "toolbox"),)
    """Your object: a folder with one URDF, or the URDF itself (docs/objects.md)."""
    out: Path | None = None
    """Folder for takes, run and results; default: runs/NAME of the object. Another object or number of steps needs
    a folder of its own."""
    weights: str = "quest-s16"
    """Weights to start from."""
    takes: int = 12
    """Takes to learn from; a third as many choose, and as many again are held out."""
    procedural: int = 0
    """Procedural objects to learn from as well, so that the network keeps what it knows of others."""
    steps: int = 300
    """Training steps of the finder."""
    learning_rate: float = 1e-4
    """A twentieth of what training anew takes: the weights are good already."""

    @property
    def folder(self) -> Path:
        """Where everything goes: objects do not share a run, which would go on from one to the other."""
        return self.out or Path("runs") / Path(self.objects[0]).resolve().name.removesuffix(".urdf")

    def run(self) -> None:
        """Run all steps and print the table."""
        takes, run = self.folder / "takes", self.folder / "run"
        few = max(2, self.takes // 3)
        for name, seed, count, every in (
            ("mine", 0, self.takes, 3),
            ("choose", 1000, few, 2),
            ("held-out", 2000, few, 2),
        ):
            say("generate", objects=self.objects, takes_per_object=count, seed=seed, every=every, out=takes / name)
        data = [takes / "mine"]
        if self.procedural:
            data.append(takes / "procedural")
            say("generate", "--no-partnet", split="train", procedural=self.procedural, every=3, out=data[-1])
        self.judge(self.weights, "before")
        training = {
            "training.steps": self.steps,
            "training.learning-rate": self.learning_rate,
            "training.warmup-steps": max(1, min(100, self.steps // 10)),
            "training.validate-every": max(1, self.steps // 6),
        }
        say("train", data=data, validation=takes / "choose", weights=self.weights, out=run, **training)
        mine = run / "weights.safetensors"
        say("weights", "tune", str(mine), takes=takes / "choose")
        self.judge(mine, "after")
        self.compare()
        example = min((takes / "held-out").glob("*.zarr"))
        print(f"\nnow: quest track {example} --weights {mine} --out outputs/mine")

    def judge(self, weights: str | Path, name: str) -> None:
        """Evaluate weights on the takes that are held out."""
        held_out, out = self.folder / "takes" / "held-out", self.folder / f"{name}.json"
        say("eval", takes=held_out, split="unlisted", trackers="quest", protocol="semantic", weights=weights, out=out)

    def compare(self) -> None:
        """Print the moved entities of both result files beside each other."""
        table = Table("weights", "tracks", "APE", "D@100", "Acc %", "recall %", box=None, pad_edge=False)
        for name in ("before", "after"):
            for row in read_results(self.folder / f"{name}.json").rows:
                if row.reading == "moved" and row.tracker == "quest":
                    table.add_row(name, *figures(row))
        Console().print(table)


def figures(row: Row) -> list[str]:
    """The cells of a row of the table."""
    m = row.metrics
    share = [f"{100 * value.mean:.1f}" if value else "" for value in (m.acc, m.recall)]
    return [str(row.tracks), *(f"{value.mean:.3f}" if value else "" for value in (m.ape, m.d100)), *share]


def say(*words: str, **options: object) -> None:
    """Print a `quest` command and run it; an option may have several values."""
    command = list(words)
    for name, value in options.items():
        values = value if isinstance(value, list | tuple) else [value]
        command += [f"--{name.replace('_', '-')}", *map(str, values)]
    print(f"\n$ {shlex.join(['quest', *command])}", flush=True)
    subprocess.run([sys.executable, "-m", "quest.cli.main", *command], check=True)


if __name__ == "__main__":
    tyro.cli(FineTune).run()
