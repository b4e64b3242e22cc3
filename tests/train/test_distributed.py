"""Two processes on the CPU learn what one does, however they were started."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from safetensors.torch import load_file

from quest.paper.network import read_paper
from tests.paper.tiny import make_paper
from tests.tolerances import TRAINED, approx
from tests.train.prepared import make_store, prepare
from tests.train.processes import train

pytest.importorskip("lightning_fabric")
pytest.importorskip("tensorboard")

pytestmark = [pytest.mark.slow, pytest.mark.skipif(os.name == "nt", reason="gloo and relaunching differ on Windows")]

PROGRAM = str(Path(__file__).with_name("processes.py"))
TORCHRUN = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2")


@pytest.fixture(scope="module")
def one_process(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, list[float]]:
    """Features, the folder of a run of one process, and its losses."""
    root = tmp_path_factory.mktemp("processes")
    prepare(root, make_paper(), (0, 1))
    return root / "cache", root / "one", train(root / "cache", root / "one", devices=1, accumulate=1)


@pytest.mark.parametrize(
    ("start", "devices", "accumulate"),
    [((), 2, (1,)), (TORCHRUN, 1, (1, 2))],
    ids=["relaunched", "torchrun"],
)
def test_two_processes_learn_what_one_does(
    one_process: tuple[Path, Path, list[float]],
    tmp_path: Path,
    start: tuple[str, ...],
    devices: int,
    accumulate: tuple[int, ...],
):
    cache, one, losses = one_process
    run(*start, PROGRAM, str(cache), str(tmp_path), str(devices), *map(str, accumulate))
    for parts in accumulate:
        out = tmp_path / str(parts)
        told = json.loads((out / "losses.json").read_text())
        assert told["processes"] == 2
        assert told["losses"] == approx(losses, TRAINED)
        ours, theirs = (load_file(folder / "last" / "weights.safetensors") for folder in (out, one))
        gap = max(float((ours[name] - theirs[name]).abs().max()) for name in theirs)
        assert gap < 2e-3, "four steps of at most 1e-3 each would differ by up to 8e-3 if they went elsewhere"


def test_the_command_prepares_features_once_and_writes_one_file(tmp_path: Path):
    network = make_paper()
    network.save(tmp_path / "tiny.safetensors", about="tiny")
    make_store(tmp_path / "takes", (0, 1))
    make_store(tmp_path / "choose", (100_002,))
    run(
        *("-m", "quest.cli.main", "train", "--stage", "1", "--data", str(tmp_path / "takes")),
        *("--validation", str(tmp_path / "choose"), "--weights", str(tmp_path / "tiny.safetensors")),
        *("--out", str(tmp_path / "run"), "--windows.batch", "4", "--training.steps", "2", "--training.devices", "2"),
        *("--training.accelerator", "cpu", "--training.validation-batches", "1"),
    )
    assert read_paper(tmp_path / "run" / "weights.safetensors").network.config == network.config
    assert len(list((tmp_path / "run" / "curves").iterdir())) == 1, "one process writes"


def run(*arguments: str) -> None:
    """A Python program, given a minute or two."""
    done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
