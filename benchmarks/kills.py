"""Every long command, killed at random moments: is anything torn, and is what a second run ends with the same?

    python -m benchmarks.kills --takes TAKES --teach TAKES --choose TAKES --out benchmarks/results/kills.json

Every command runs once undisturbed. Then it is killed (SIGKILL) at a random moment of that time, again and again in
folders of their own, and run once more to its end, unless all of it was there already. What stands in the folder then
is compared with the first run: tensors, tables and takes to the bit, JSON without times, durations and commands, videos
by their size. After a kill every file of a known kind must be readable, but for those whose names say that they are
being written.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import tyro
from rich.console import Console
from safetensors.numpy import load_file

from quest.data.store import TakeStore
from quest.data.video import read_video
from quest.evaluation.report import provenance, write_report

VOLATILE = (
    "stamp",
    "command",
    "seconds",
    "wall",
    "per_second",
    "_ms",
    "_s",
    "created",
    "date",
    "argv",
    "out",
    "folder",
    "file",
)
"""Endings of keys of JSON that differ between two runs."""
WAIT_S = 600


def tensors(path: Path) -> str:
    """What a file of weights holds."""
    return digest(*(name.encode() + array.tobytes() for name, array in sorted(load_file(path).items())))


def table(path: Path) -> str:
    """What a table holds, without columns of durations."""
    rows = pq.read_table(path)
    kept = [name for name in rows.column_names if not name.endswith(VOLATILE)]
    return digest(json.dumps(rows.select(kept).to_pylist(), default=str).encode())


def words(path: Path) -> str:
    """What JSON says."""
    return digest(json.dumps(settled(json.loads(path.read_text())), sort_keys=True).encode())


def settled(value: Any) -> Any:
    """JSON without what differs between two runs."""
    if isinstance(value, dict):
        return {key: settled(item) for key, item in value.items() if not key.endswith(VOLATILE)}
    return [settled(item) for item in value] if isinstance(value, list) else value


def digest(*parts: bytes) -> str:
    """A few letters that tell bytes apart."""
    return hashlib.blake2b(b"\0".join(parts), digest_size=12).hexdigest()


READERS: dict[str, Callable[[Path], str]] = {
    ".safetensors": tensors,
    ".parquet": table,
    ".json": words,
    ".mp4": lambda path: digest(str(read_video(path)[0].shape).encode()),  # x264 does not give the same bytes each time
}


def contents(folder: Path) -> dict[str, str]:
    """What the files of a folder hold; those of takes as a store reads them."""
    found: dict[str, str] = {}
    takes = {path for path in folder.rglob("*.zarr") if path.is_dir() and not hidden(path, folder)}
    for root in {path.parent for path in takes}:
        for name in TakeStore(root).names():
            clip = TakeStore(root).read(name).views[0].clip
            depth_m = np.zeros(0) if clip.depth_m is None else clip.depth_m
            found[name] = digest(clip.rgb.tobytes(), depth_m.tobytes(), clip.cam_from_world.tobytes())
    for path in folder.rglob("*"):
        read = READERS.get(path.suffix)
        if read is not None and path.is_file() and not hidden(path, folder) and not takes & set(path.parents):
            found[path.relative_to(folder).as_posix()] = read(path)
    return found


def hidden(path: Path, folder: Path) -> bool:
    """Whether a name on the way says that something is being written, or is only kept to go on."""
    parts = path.relative_to(folder).parts
    return any(part.startswith(".") or "partial" in part or part in ("cache", "checkpoints") for part in parts)


@dataclass(frozen=True)
class Kills:
    """Kill every long command at random moments."""

    takes: Path
    """A small store of takes, to track and export."""
    teach: Path | None = None
    """A small store of takes of training objects; training is left out without it."""
    choose: Path | None = None
    """The same of validation objects."""
    kills: int = 20
    """How often each is killed."""
    only: tuple[str, ...] = ()
    """Names of commands; all by default."""
    seed: int = 0
    """Of the moments."""
    out: Path | None = None
    """Result file, written anew after every command."""

    def commands(self) -> dict[str, list[str]]:
        """The commands; OUT stands for their folder."""
        takes = str(self.takes)
        quick = ["--training.steps", "12", "--training.validate-every", "4", "--training.validation-batches", "1"]
        return {
            "generate": [
                *("generate", "--out", "OUT/takes", "--procedural", "2", "--takes-per-object", "2"),
                *("--frames-per-joint", "12", "--frames", "24"),
            ],
            "train": [
                *("train", "--stage", "1", "--weights", "quest-paper", "--data", str(self.teach)),
                *("--validation", str(self.choose), "--windows.batch", "2", "--training.precision", "32-true"),
                *(*quick, "--out", "OUT/run"),
            ],
            "track": ["track", "sample", "--out", "OUT/sample"],
            "eval": ["eval", "--takes", takes, "--trackers", "lk", "hold-still", "--out", "OUT/result.json"],
            "export": ["data", "export", takes, "--format", "lerobot", "--out", "OUT/dataset"],
        }

    def run(self) -> int:
        """Kill them all; 1 if anything was torn or differs."""
        console, rng, rows = Console(highlight=False), np.random.default_rng(self.seed), list[dict[str, Any]]()
        for name, command in self.commands().items():
            if (self.only and name not in self.only) or (name == "train" and self.teach is None):
                continue
            with tempfile.TemporaryDirectory(prefix="quest-kills-") as folder:
                rows.append({"command": name} | self._torture(Path(folder), command, rng))
            console.print(rows[-1])
            if self.out is not None:
                write_report(provenance() | {"rows": rows}, self.out)
        return int(any(row["torn"] or row["different"] or row["failed"] for row in rows))

    def _torture(self, root: Path, command: Sequence[str], rng: np.random.Generator) -> dict[str, Any]:
        whole = root / "whole"
        begun_s = time.monotonic()
        if (ended := run(command, whole)) != 0:
            return {"kills": 0, "torn": 0, "different": 0, "failed": 1, "why": [f"undisturbed: exit code {ended}"]}
        lasts_s, expected = time.monotonic() - begun_s, contents(whole)
        why, counts = list[str](), {"kills": 0, "whole": 0, "torn": 0, "different": 0, "failed": 0}
        for trial in range(self.kills):
            folder = root / f"trial{trial}"
            counts["kills"] += run(command, folder, after_s=float(rng.uniform(0.1, lasts_s))) == -signal.SIGKILL
            try:
                whole_already = contents(folder) == expected
            except Exception as error:  # whatever it is, the file is torn
                whole_already = False
                counts["torn"] += 1
                why.append(f"{trial}: torn: {error}")
            if whole_already:
                counts["whole"] += 1
            elif run(command, folder) != 0:
                counts["failed"] += 1
                why.append(f"{trial}: the second run failed")
            elif (found := contents(folder)) != expected:
                counts["different"] += 1
                apart = sorted(n for n in found.keys() | expected.keys() if found.get(n) != expected.get(n))
                why.append(f"{trial}: different: {', '.join(apart[:5])}")
            shutil.rmtree(folder)
        return {"seconds": round(lasts_s, 1), "files": len(expected), **counts, "why": why}


def run(command: Sequence[str], folder: Path, *, after_s: float | None = None) -> int:
    """The exit code of a command of quest, in which OUT stands for the folder; it may be killed after some seconds."""
    folder.mkdir(parents=True, exist_ok=True)
    words = [sys.executable, "-m", "quest", *(word.replace("OUT", str(folder)) for word in command)]
    with (folder / ".log").open("ab") as log:
        process = subprocess.Popen(words, stdout=log, stderr=log)
        try:
            return process.wait(WAIT_S if after_s is None else after_s)
        except subprocess.TimeoutExpired:
            process.kill()
            return process.wait()


if __name__ == "__main__":
    raise SystemExit(tyro.cli(Kills).run())
