"""Fit the network that tells a loss from the filter's readings, with depth (``quest.model.doubt``).

    python -m benchmarks.fit_doubt --takes STORE... --real SETS... --records DIR --out doubt.safetensors

Three kinds of streams teach, by answers that are right or lost: every view of takes of training objects, followed by
the true pixels of entities; half of these takes once more, followed by pixels anywhere, a third of them with depth at
half the rate; and labelled real recordings, with their poses and without.

Simulated objects are parted in five, and each part is told by a network that the others taught. Of real recordings
some teach, and the others are told by the network that is written. These figures, beside those of the filter's own
odds, go into ``benchmarks/results/doubt.json``.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import torch.nn.functional as F
import tyro
from jaxtyping import Bool, Float32, Int
from scipy.special import expit

import quest
from quest.data.store import TakeStore
from quest.evaluation.drift import auroc
from quest.evaluation.real.run import shown
from quest.evaluation.real.sets import LabelledClip, open_set
from quest.evaluation.report import provenance, write_report
from quest.evaluation.selection import Shard, select_takes
from quest.evaluation.stream_record import FAR_PX, WIDTH_PX, record_streams, tracker_id
from quest.filter.queries import READINGS
from quest.filter.view import View, in_image, move
from quest.model.doubt import LIMIT, Doubt, save_doubt
from quest.track import Tracker
from quest.types import Clip, Take
from quest.whole_file import whole_file

FOLDS = 5
POINTS = 10
"""That are drawn from a picture."""
_AWAY_PX = 9
"""Side of the square around each that is on one link."""
NEAR_PX = 16.0
"""An answer is right up to here: of a real recording, or of a point anywhere in a picture 640 px wide."""


@dataclass(frozen=True, eq=False)
class Told:
    """N answers that are right or lost, of one object or recording."""

    of: str
    readings: Float32[np.ndarray, "N R"]
    lost: Bool[np.ndarray, " N"]
    moved: Bool[np.ndarray, " N"]
    """Whether the entity moves against the world."""
    real: bool


@dataclass(frozen=True)
class FitDoubt:
    """Fit the network of losses to takes of training objects and to real recordings."""

    takes: tuple[Path, ...]
    """Stores with takes of training objects."""
    real: tuple[Path, ...]
    """Sets of labelled recordings with depth."""
    records: Path
    """Folder for recorded streams of the takes."""
    out: Path
    """File of the network."""
    teaching: tuple[str, ...] = ("desk_a", "desk_b")
    """Recordings of these sets that teach; by default those whose licence lets anyone use what they taught."""
    results: Path = Path(__file__).parent / "results" / "doubt.json"
    hidden: int = 24
    """Width of each network."""
    networks: int = 3
    """How many are averaged; they become one of so many times the width."""
    steps: int = 1500
    """Of AdamW, by 4,096 answers."""
    decay: float = 0.1
    real_weight: float = 2.0
    """How much a real answer counts."""
    shard: str = "0/1"
    """Part of the streams to record, such as 0/2; the last to finish fits."""

    def main(self) -> None:
        """Record, cross-validate, fit to all of it, write."""
        tracker = quest.load(monitor=False)
        chosen = [(store, select_takes(store.infos(), split=["train"])) for store in map(TakeStore, self.takes)]
        shard = Shard.parse(self.shard)
        for store, names in chosen:
            self._points(tracker, store, [name for i, name in enumerate(names) if i in shard])
        recorded = record_streams(tracker, chosen, self.records, inputs="depth", shard=shard)
        if recorded.missing:
            print(f"left to other shards: {recorded.missing} streams; nothing is fitted yet")
            return
        told = [each for store, names in chosen for each in self._points(tracker, store, list(names))]
        for r in recorded.records:
            known = r.judged & np.isfinite(r.readings).all(axis=-1)
            moved = np.broadcast_to(r.moved, known.shape)[known]
            told.append(Told(r.object_id, r.readings[known], r.lost[known], moved, real=False))
        for folder in self.real:
            found = open_set(folder)
            told += [each for clip in found.clips for each in _followed(tracker, clip, found.far_px)]
        teach = [t for t in told if not t.real or t.of in self.teaching]
        doubt = self._fit(teach)
        about = f"fitted to {len(recorded.records)} simulated streams and {sum(t.real for t in teach)} real ones"
        save_doubt(doubt, self.out, readings=READINGS, about=about)
        rows = self._figures(teach, [t for t in told if t not in teach], doubt)
        write_report(provenance() | {"by": self._settings(teach), "rows": rows}, self.results)
        print(json.dumps(rows, indent=1))

    def _points(self, tracker: Tracker, store: TakeStore, names: Sequence[str]) -> list[Told]:
        """What is told of points anywhere, of every second take; of every third of these by depth at half the rate."""
        told = []
        for name in names:
            drawn = _number(name)
            if drawn % 2:
                continue
            path = self.records / f"{name}-points-{tracker_id(tracker)}.npz"
            if not path.exists():
                followed = _anywhere(tracker, store.read(name), half=drawn % 3 == 0)
                with whole_file(path) as partial:
                    np.savez_compressed(partial, **vars(followed))
            with np.load(path) as file:
                told.append(Told(str(file["of"]), file["readings"], file["lost"], file["moved"], real=False))
        return told

    def _settings(self, teach: Sequence[Told]) -> dict[str, Any]:
        names = ("hidden", "networks", "steps", "decay", "real_weight", "teaching")
        counts = {
            kind: {
                "streams": len(own := [t for t in teach if t.real == real]),
                "answers": sum(len(t.lost) for t in own),
                "lost": int(sum(t.lost.sum() for t in own)),
            }
            for kind, real in (("simulated", False), ("real", True))
        }
        return {name: getattr(self, name) for name in names} | counts

    def _figures(self, teach: Sequence[Told], others: Sequence[Told], doubt: Doubt) -> list[dict[str, Any]]:
        """Of answers by networks that were not taught by them, beside networks of the filter's own odds alone."""
        of, own = sorted({t.of for t in teach}), READINGS.index("lost")
        fold = dict(zip(of, np.random.default_rng(0).permutation(len(of)) % FOLDS, strict=True))
        order, network = list(others), [doubt.log_odds(t.readings) for t in others]
        alone = self._fit(teach, only=own)
        odds = [alone.log_odds(t.readings[:, own : own + 1]) for t in others]
        for k in range(FOLDS):
            rest, held_out = ([t for t in teach if (fold[t.of] != k) == other] for other in (True, False))
            each, alone = self._fit(rest), self._fit(rest, only=own)
            order += held_out
            network += [each.log_odds(t.readings) for t in held_out]
            odds += [alone.log_odds(t.readings[:, own : own + 1]) for t in held_out]
        lost, moved = (np.concatenate([getattr(t, name) for t in order]) for name in ("lost", "moved"))
        kind = np.repeat([1 if t in others else 2 if t.real else 0 for t in order], [len(t.lost) for t in order])
        rows = {"simulated": kind == 0, "simulated, of what moves": (kind == 0) & moved, "real": kind == 1}
        return [
            {"by": name, "answers": row} | _measures(np.concatenate(values)[which], lost[which])
            for name, values in (("network", network), ("own odds", odds))
            for row, which in rows.items()
        ]

    def _fit(self, told: Sequence[Told], only: int | None = None) -> Doubt:
        """Some networks, averaged; of width 1 where ``only`` one reading tells."""
        columns = slice(None) if only is None else slice(only, only + 1)
        readings = torch.from_numpy(np.concatenate([t.readings[:, columns] for t in told]))
        lost = torch.from_numpy(np.concatenate([t.lost for t in told])).float()
        weight = torch.cat([torch.full((len(t.lost),), self.real_weight if t.real else 1.0) for t in told])
        mean, scale = readings.mean(dim=0), readings.std(dim=0) + 1e-3
        apart = ((readings - mean) / scale).clamp(-LIMIT, LIMIT)
        width = self.hidden if only is None else 1
        parts = [self._one(apart, lost, weight, seed, width) for seed in range(self.networks)]
        doubt = Doubt(readings.shape[1], width * self.networks)
        doubt.mean, doubt.scale = mean, scale
        state = {
            "hidden.weight": torch.cat([each.hidden.weight for each in parts]),
            "hidden.bias": torch.cat([each.hidden.bias for each in parts]),
            "out.weight": torch.cat([each.out.weight for each in parts], dim=1) / self.networks,
            "out.bias": torch.stack([each.out.bias for each in parts]).mean(dim=0),
        }
        doubt.load_state_dict(doubt.state_dict() | state)
        return doubt.eval().requires_grad_(False)

    def _one(self, readings: torch.Tensor, lost: torch.Tensor, weight: torch.Tensor, seed: int, width: int) -> Doubt:
        torch.manual_seed(seed)
        network = Doubt(readings.shape[1], width)
        optimizer = torch.optim.AdamW(network.parameters(), lr=5e-3, weight_decay=self.decay)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, self.steps)
        for _ in range(self.steps):
            batch = torch.randint(len(lost), (4096,))
            each = F.binary_cross_entropy_with_logits(network(readings[batch]), lost[batch], reduction="none")
            optimizer.zero_grad()
            (weight[batch] * each).mean().backward()
            optimizer.step()
            schedule.step()
        return network


def _anywhere(tracker: Tracker, take: Take, *, half: bool) -> Told:
    """What is told of points that are drawn from the first picture, wherever they are."""
    view, rng = take.views[0], np.random.default_rng(_number(take.info.name) >> 224)
    clip, links = view.clip, view.link_id[0]
    assert clip.depth_m is not None
    around = np.ones((_AWAY_PX, _AWAY_PX), np.uint8)
    inside = (cv2.erode(links, around) == cv2.dilate(links, around)) & (clip.depth_m[0] > 0)
    row, column = rng.permutation(np.argwhere(inside))[:POINTS].T
    at_px = np.stack([column, row], axis=-1) + 0.5
    seen = [View(clip.camera.matrix.astype(np.float64), clip.frame(t).cam_from_world, None) for t in range(len(clip))]
    point, link = seen[0].lift(at_px, clip.depth_m[0][row, column].astype(np.float64)), links[row, column].astype(int)
    poses = np.concatenate([np.tile(np.eye(4), (len(take), 1, 1, 1)), take.link_pose.astype(np.float64)], axis=1)
    true = move(poses[:, link] @ np.linalg.inv(poses[0, link]), point[None])
    true_px = np.stack([one.project(each)[0] for one, each in zip(seen, true, strict=True)])
    queries = [quest.Query.point(0, *map(float, each)) for each in at_px]
    uv_px, readings = _read(tracker, clip, queries, every=2 if half else 1)
    off = np.linalg.norm(uv_px - true_px, axis=-1) * WIDTH_PX / clip.camera.width
    known = np.isfinite(readings).all(axis=-1) & in_image(true_px, (clip.camera.width, clip.camera.height))
    known &= (off <= NEAR_PX) | (off > FAR_PX)
    moved = np.broadcast_to(
        np.linalg.norm(true - true[:1], axis=-1).max(axis=0) > 0.1 * take.info.half_diagonal_m, off.shape
    )
    return Told(take.info.object_id, readings[known], off[known] > NEAR_PX, moved[known], real=False)


def _number(name: str) -> int:
    """Of 256 bits, drawn for a name."""
    return int(hashlib.sha256(name.encode()).hexdigest(), 16)


def _read(tracker: Tracker, clip: Clip, queries: list[quest.Query], every: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Pixels and readings of queries in every frame, of which every so many bring depth; NaN until they are asked."""
    stream, shape = tracker.stream(clip.camera, queries, alpha=None), (len(clip), len(queries))
    uv_px, readings = np.full((*shape, 2), np.nan), np.full((*shape, len(READINGS)), np.nan, np.float32)
    for t in range(len(clip)):
        frame = clip.frame(t)
        depth_m = frame.depth_m if t % every == 0 else None
        state = stream.step(frame.rgb, depth_m, frame.stamp_s, frame.cam_from_world)
        uv_px[t, list(state.query)] = state.uv_px
        if (followed := stream.memory.filter) is not None:
            readings[t, list(state.query)] = followed.queries.readings
    return uv_px, readings


def _followed(tracker: Tracker, labelled: LabelledClip, far_px: float) -> list[Told]:
    """What is told of the visible labels of a recording, followed with depth, with poses and without."""
    labels, made = labelled.labels, []
    at: tuple[Int[np.ndarray, " S"], ...] = labels.frame[labels.scored], labels.track[labels.scored]
    for inputs, clip in shown(labelled.read()).items():
        if inputs == "colours":
            continue
        uv_px, readings = _read(tracker, clip, labels.queries())
        error_px = np.linalg.norm(uv_px[at] - labels.uv_px[labels.scored], axis=-1)
        known = (labels.state[labels.scored] == "visible") & np.isfinite(readings[at]).all(axis=-1)
        known &= (error_px <= NEAR_PX) | (error_px > far_px)
        moved = np.zeros(known.sum(), bool)
        made.append(Told(labelled.name, readings[at][known], error_px[known] > NEAR_PX, moved, real=True))
    return made


def _measures(score: np.ndarray, lost: np.ndarray) -> dict[str, float | None]:
    """Of log odds of a loss; None where there is nothing to tell."""
    p = expit(score)
    told = p > 0.5
    return {
        "n": len(lost),
        "lost": float(lost.mean()),
        "auroc": auroc(score, lost),
        "log_loss": float(-(np.log(p[lost] + 1e-9).sum() + np.log(1 - p[~lost] + 1e-9).sum()) / len(lost)),
        "p_lost_median": float(np.median(p[lost])) if lost.any() else None,
        "p_right_median": float(np.median(p[~lost])),
        "p_right_90": float(np.quantile(p[~lost], 0.9)),
        "told_lost": float(told[lost].mean()) if lost.any() else None,
        "told_rightly": float(lost[told].mean()) if told.any() else None,
    }


if __name__ == "__main__":
    tyro.cli(FitDoubt).main()
