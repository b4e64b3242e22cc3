"""Make the golden files.

    python -m tests.golden render     simulated clips and their truth again, which takes minutes (quest generate)
    python -m tests.golden record     what the tracker says of all clips now; with --figures also how good that is

Record on purpose: a change of the answers is then a change of files that a reader sees. Figures are what the bounds of
the test rest on, so that they only get better.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from dataclasses import asdict, dataclass, replace
from typing import Annotated

import numpy as np
import tyro

from quest.cli.main import main
from quest.data.cut import cut_clip
from quest.data.recording import write_recording
from quest.data.store import TakeStore
from quest.types import Take
from tests.golden.streams import (
    CLIPS,
    GoldenClip,
    Truth,
    arrays_of,
    follow,
    judge,
    load,
    write_depth,
)

HIDDEN_FRAMES = 12
IN_FRONT, BEHIND = 20, 24
"""Frames that are kept in front of the hidden ones and after them."""


@dataclass(frozen=True)
class Render:
    """Render the simulated clips and write them with their truth."""

    only: tuple[str, ...] = ()
    """Names of clips; all of them by default."""

    def run(self) -> int:
        """Write the files of every simulated clip."""
        for clip in CLIPS:
            if clip.take is not None and (not self.only or clip.name in self.only):
                with tempfile.TemporaryDirectory() as folder:
                    code = main(generate(clip.take, folder))
                    if code:
                        return code
                    store = TakeStore(folder)
                    write(clip, store.read(store.names()[0]))
        return 0


def generate(take: tuple[str, int], folder: str) -> list[str]:
    """Arguments of the command that renders a take."""
    name, seed = take
    what = ["generate", "--objects", f"procedural:{name}", "--seed", str(seed), "--out", folder]
    return [*what, "--suite", "occlusion", "--hidden", str(HIDDEN_FRAMES), "--look-alike", "--size", "480"]


def write(golden: GoldenClip, take: Take) -> None:
    """The frames around those in which an entity is hidden, and what is true of them."""
    view, e = take.views[0], [entity.name for entity in take.info.entities].index(golden.entities[0])
    hidden = np.flatnonzero(~view.visible[:, e])
    rows = slice(max(hidden[0] - IN_FRONT, 0), hidden[-1] + 1 + BEHIND)
    clip = cut_clip(view.clip, rows)
    assert clip.depth_m is not None
    shutil.rmtree(golden.folder, ignore_errors=True)
    write_recording(replace(clip, name=golden.name, depth_m=None), golden.folder)
    write_depth(golden.folder, clip.depth_m)
    truth_of(take, rows).write(golden.folder)


def truth_of(take: Take, rows: slice) -> Truth:
    """What is true of all entities of a take that a tracker follows."""
    e, moved = take.tracked, take.moved
    entities = [take.info.entities[i] for i in e]
    moves = [bool(moved[i]) and entity.joint >= 0 for i, entity in zip(e, entities, strict=True)]
    kinds = [take.info.joints[x.joint].kind if m else "static" for x, m in zip(entities, moves, strict=True)]
    axes = [take.joint_axis[0, x.joint, 3:] if m else np.zeros(3) for x, m in zip(entities, moves, strict=True)]
    return Truth(
        name=np.array([x.name for x in entities], dtype=np.str_),
        uv_px=take.views[0].uv_px[rows, e].astype(np.float32),
        visible=take.views[0].visible[rows, e],
        point_world=take.point_world[rows, e].astype(np.float32),
        joint=np.array(kinds, dtype=np.str_),
        axis=np.array(axes, dtype=np.float32),
        half_diagonal_m=np.array(take.info.half_diagonal_m, dtype=np.float32),
    )


@dataclass(frozen=True)
class Record:
    """Record what the tracker says of all clips."""

    only: tuple[str, ...] = ()
    """Names of clips; all of them by default."""
    processor: str = ""
    """Kind of processor, such as amd, whose answers are kept beside the others, because rounding leads it elsewhere."""
    figures: bool = False
    """Also write how good it is, which moves the bounds of the test."""

    def run(self) -> int:
        """Write the answers of every clip."""
        tracker = load()
        for golden in CLIPS:
            if self.only and golden.name not in self.only:
                continue
            clip, truth, answers, rows = golden.read(), golden.truth(), {}, {}
            for stride in golden.strides:
                tracks = follow(tracker, clip, golden.queries(truth), stride)
                answers |= {f"{stride}/{name}": value for name, value in arrays_of(tracks).items()}
                rows[stride] = {name: asdict(row) for name, row in judge(tracks, truth, stride).items()}
                sys.stdout.write(f"{golden.name} {stride} {json.dumps(rows[stride])}\n")
            golden.folder.mkdir(exist_ok=True)
            name = f"answers-{self.processor}.npz" if self.processor else "answers.npz"
            np.savez_compressed(golden.folder / name, **answers)
            if self.figures:
                (golden.folder / "figures.json").write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
        return 0


Command = Annotated[Render, tyro.conf.subcommand("render")] | Annotated[Record, tyro.conf.subcommand("record")]

if __name__ == "__main__":
    sys.exit(tyro.cli(Command, description=__doc__).run())
