"""How good the answers to the sample clips are, against the truth beside them, and whether their alarms are honest.

    python benchmarks/judge_sample.py

A query's entity is the one that its first answer is nearest to. Lost is as where the monitor is judged with depth
(:func:`quest.evaluation.stream_record.bands`).
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

import quest
from quest.data.recording import read_recording
from quest.data.sample import SAMPLES, sample_folder
from quest.evaluation.metrics import distance_px
from quest.evaluation.stream_record import FAR, LEAST_S, LIFTING_PX, NEAR, lasting, runs
from quest.types import Camera, Tracks

COLUMNS = ("query", "entity", "px", "mm", "worst mm", "last mm", "joint", "truly", "axis deg", "lost s", "alarm s")


@dataclass(frozen=True)
class JudgeSample:
    """Track the sample clips with weights, and print one row per query: medians over frames in which it is seen."""

    clip: tuple[str, ...] = SAMPLES
    """Which clips."""
    weights: tuple[str, ...] = ("quest-s16",)
    """Which weights."""

    def run(self) -> int:
        """Track and print."""
        console = Console(width=150)
        for weights in self.weights:
            tracker = quest.load(weights)
            for name in self.clip:
                truth = json.loads((sample_folder(name) / "truth.json").read_text())
                clip = read_recording(sample_folder(name))
                tracks = tracker.track(clip)
                table = Table(title=f"{name}, {weights}")
                for column in COLUMNS:
                    table.add_column(column)
                for k in range(len(tracks.names)):
                    table.add_row(*judge(tracks, truth, k, clip.camera))
                console.print(table)
        return 0


def judge(tracks: Tracks, truth: dict[str, Any], k: int, camera: Camera) -> list[str]:
    """A row of the table."""
    assert tracks.joints is not None
    entities = truth["entities"]
    points = np.array([entity["point_world_m"] for entity in entities])
    off_m = np.linalg.norm(points - tracks.point_world[:, k], axis=-1)
    bound = np.isfinite(off_m).all(axis=0)
    e = int(off_m[:, bound.argmax()].argmin())
    entity, own_m = entities[e], off_m[e]
    true_px = np.array(entity["uv_px"])
    off_px = np.linalg.norm(true_px - tracks.uv_px[:, k], axis=-1)
    seen = np.zeros(len(tracks), bool)
    for start, end in entity["visible_frames"]:
        seen[start:end] = True
    own, other = (gap_m / truth["half_diagonal_m"] for gap_m in (own_m, np.delete(off_m, e, axis=0).min(axis=0)))
    on_it = seen & (distance_px(tracks.uv_px[:, k], true_px, width=camera.width, height=camera.height) <= LIFTING_PX)
    right = (own <= NEAR) & (own <= other) | on_it
    wrong = bound & ~right & ((own > FAR) | (own > NEAR) & (other < own / 2))
    lost = lasting(wrong[:, None], tracks.stamp_s, LEAST_S)[:, 0]
    kind = entity["joint"]["kind"] if entity["moves"] else "static"
    angle = ""
    if kind == tracks.joints.kind[k] != "static":
        cosine = abs(float(tracks.joints.axis[k] @ np.array(entity["joint"]["axis"])))
        angle = f"{np.degrees(np.arccos(min(cosine, 1.0))):.1f}"
    return [
        tracks.names[k],
        entity["name"],
        f"{np.median(off_px[seen & bound]):.1f}",
        *(f"{1e3 * value:.0f}" for value in (np.median(own_m[seen & bound]), own_m[bound].max(), own_m[-1])),
        tracks.joints.kind[k],
        kind,
        angle,
        _spans(lost, tracks.stamp_s),
        "not watched" if tracks.alarm is None else _spans(tracks.alarm[:, k], tracks.stamp_s),
    ]


def _spans(flags: np.ndarray, stamp_s: np.ndarray) -> str:
    last = len(stamp_s) - 1
    return ", ".join(f"{stamp_s[start]:.2f} to {stamp_s[min(end, last)]:.2f}" for start, end in runs(flags))


if __name__ == "__main__":
    sys.exit(tyro.cli(JudgeSample).run())
