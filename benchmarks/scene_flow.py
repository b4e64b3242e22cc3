"""Measure the flow head of the published network: EPE3D beside zero flow and differences of lifted points.

    python -m benchmarks.scene_flow --takes STORE --weights FILE --out benchmarks/results/scene_flow/validation.json

A stride of 1 asks for the next frame, as a stream would; a larger one for the frame as far on as the frames of the
window are apart, which is what training on thinned takes looks like. Features are prepared in a cache that can be
kept. The result file is written anew after each take, and says until the last one that it is not complete.

Every frame of a view is the newest one of a window of the network's T frames, a stride apart, and every scored entity
is asked for its displacement one stride on. Slots are matched to entities at one frame: that of the first eight in
which most entities are seen. An entity that gets no slot there is not judged. What each answer rests on:

- ``head``: the flow head, which sees the window;
- ``zero``: nothing moves; sees nothing;
- ``lifted``: the last difference of the network's own lifted answers in the newest two frames of the same window, as
  if motion went on; 0 where either is not lifted. It sees what the head sees;
- ``lifted-truth``: the same of the depth at the *true* pixels, which no tracker knows; 0 where the entity is hidden in
  either frame or has no depth. It shows what lifting alone costs.
"""

from __future__ import annotations

import tempfile
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from itertools import product
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from jaxtyping import Bool, Float
from torch import Tensor

from benchmarks.study import Study
from quest.data.provenance import file_hash
from quest.data.split import SplitPart
from quest.data.store import TakeStore
from quest.errors import ConfigError, WeightsError
from quest.evaluation.bootstrap import Pool
from quest.evaluation.protocols import START_FRAMES
from quest.model.frames import FrameBatch
from quest.model.weights import find_weights
from quest.paper.network import PaperNetwork, read_paper
from quest.paper.objective import PaperStageOne
from quest.track.tracker import pick_device
from quest.train.feature_cache import CachedView, FeatureCache
from quest.train.settings import WindowConfig
from quest.train.windows import WindowPlan, WindowSampler, WindowTruth

ANSWERS = ("head", "zero", "lifted", "lifted-truth")
READINGS = ("all", "moved", "moving")
"""All entities; those that are at some time more than 0.1 from rest; and the steps of those above 0.005 long."""
MOVED, MOVING = 0.1, 0.005


@dataclass(frozen=True)
class FlowRecord:
    """Errors of one entity in one view, summed over the frames that have a next one."""

    take: str
    view: str
    """Name of the prepared view."""
    object_id: str
    part: str
    source: str
    suite: str
    level: int
    stride: int
    """Frames between the frames of a window."""
    moved: bool
    """Whether the entity is at some time more than 0.1 from rest."""
    total: dict[str, float]
    """Sum of errors per answer, normalised units."""
    count: int
    """Frames."""
    moving_total: dict[str, float]
    """The same over steps that are longer than 0.005."""
    moving_count: int
    """How many those are."""


@dataclass(frozen=True)
class ViewFlow:
    """Errors in one view."""

    error: dict[str, Float[np.ndarray, "T K"]]
    """Per answer, normalised units; NaN where there is nothing to judge."""
    length: Float[np.ndarray, "T K"]
    """True displacement, normalised units."""
    scored: Bool[np.ndarray, " K"]
    """Entities that are seen where slots are matched."""
    moved: Bool[np.ndarray, " K"]
    """Entities that are at some time more than 0.1 from rest."""


def flow_errors(
    network: PaperNetwork, view: CachedView, *, stride: int, device: torch.device, batch: int = 8
) -> ViewFlow | None:
    """Errors of all answers in one view; None where no entity is seen in the first frames, or no frame has a next one.

    The network has a flow head and is in evaluation mode on the device; the view was prepared with its encoder.

    Raises:
        ConfigError: the stride is not at least 1.
    """
    if stride < 1:
        raise ConfigError(f"scene flow: expected a stride of at least 1, got {stride}")
    anchor = int(view.visible[:START_FRAMES].sum(axis=1).argmax())
    scored = view.visible[anchor]
    if not scored.any() or len(view) <= stride:
        return None
    parts: dict[str, list[np.ndarray]] = defaultdict(list)
    for plan in _plans(view, anchor, window=network.config.window, stride=stride, batch=batch):
        sampler = WindowSampler([view], network.config, WindowConfig(batch=len(plan)))
        frames, truth = sampler.load(plan)
        for name, error in _answers(network, frames.to(device), truth.to(device)).items():
            parts[name].append(error.float().cpu().numpy())
    joined = {name: np.concatenate(values) for name, values in parts.items()}
    gone = np.linalg.norm(view.point_world - view.point_world[:1], axis=-1).max(axis=0) / view.half_diagonal_m
    return ViewFlow(joined, joined["zero"], scored, gone > MOVED)


def records_of(flow: ViewFlow, **subject: object) -> tuple[FlowRecord, ...]:
    """One record per scored entity; ``subject`` has the first eight fields."""
    records = []
    for k in np.flatnonzero(flow.scored):
        known = np.isfinite(np.stack([error[:, k] for error in flow.error.values()])).all(axis=0)
        moving = known & (flow.length[:, k] > MOVING)
        records.append(
            FlowRecord(
                **subject,  # type: ignore[arg-type]
                moved=bool(flow.moved[k]),
                total={name: float(error[known, k].sum()) for name, error in flow.error.items()},
                count=int(known.sum()),
                moving_total={name: float(error[moving, k].sum()) for name, error in flow.error.items()},
                moving_count=int(moving.sum()),
            )
        )
    return tuple(records)


def flow_rows(records: Sequence[FlowRecord], *, resamples: int, seed: int) -> list[dict[str, Any]]:
    """EPE3D per part, source, suite, level, stride and reading."""
    names = ("part", "source", "suite", "level", "stride")
    groups: dict[tuple, list[FlowRecord]] = defaultdict(list)
    for record in records:
        groups[attrgetter(*names)(record)].append(record)
    rows = []
    for key, reading in product(sorted(groups), READINGS):
        total, count = ("moving_total", "moving_count") if reading == "moving" else ("total", "count")
        chosen = [r for r in groups[key] if reading == "all" or r.moved]
        pool = Pool(chosen, attrgetter("object_id"), resamples=resamples, seed=seed)
        judged = pool.where(attrgetter(count))
        if judged.records:
            counts = {"objects": pool.objects, "takes": len({r.take for r in chosen}), "entities": len(judged.records)}
            epe = {a: pool.mean(lambda r, a=a, t=total: getattr(r, t)[a], attrgetter(count)) for a in ANSWERS}
            rows.append(dict(zip(names, key, strict=True)) | {"reading": reading} | counts | {"epe": epe})
    return rows


def _plans(view: CachedView, anchor: int, *, window: int, stride: int, batch: int) -> Iterator[WindowPlan]:
    """Windows that end at each frame that has a next one, in batches; the first frame stands for those before it."""
    ends = range(len(view) - stride)
    for start in range(0, len(ends), batch):
        some = ends[start : start + batch]
        index = [[anchor, *(max(0, end - stride * back) for back in reversed(range(window)))] for end in some]
        yield WindowPlan(
            picks=tuple((view, frames) for frames in index),
            following=tuple(end + stride for end in some),
            entities=view.visible.shape[1],
            no_depth=np.zeros(len(some), bool),
        )


def _answers(network: PaperNetwork, frames: FrameBatch, truth: WindowTruth) -> dict[str, Float[Tensor, "B K"]]:
    with torch.inference_mode():
        answered = PaperStageOne(network).answered(frames, truth)
        flow = torch.where(answered.asked.unsqueeze(-1), network.displace(answered.embedding), torch.nan)
    newest = frames.during(slice(-2, None))
    uv_px = truth.uv[:, -2:].nan_to_num(-1) * network.config.encoder.image_size
    seen = truth.visible[:, -2:].unsqueeze(-1)
    at_truth = torch.where(seen, newest.to_reference(uv_px, newest.depth_at(uv_px)), torch.nan)
    answers = {
        "head": flow,
        "zero": torch.zeros_like(flow),
        "lifted": _difference(answered.point[:, -2:]),
        "lifted-truth": _difference(at_truth),
    }
    return {name: (a - truth.flow).norm(dim=-1) / truth.unit[:, None] for name, a in answers.items()}


def _difference(point: Float[Tensor, "B 2 K 3"]) -> Float[Tensor, "B K 3"]:
    step = point[:, 1] - point[:, 0]
    return torch.where(torch.isfinite(step).all(-1, keepdim=True), step, 0.0)


@dataclass(frozen=True)
class SceneFlow(Study):
    """EPE3D of weights with a flow head, per source, suite, level and stride."""

    weights: str = tyro.MISSING
    """Name or file of weights with a flow head (quest train --stage 2)."""
    stride: tuple[int, ...] = (1, 6)
    """Frames between the frames of a window, and to the one that is asked for."""
    cache: Path | None = None
    """Folder of the feature cache; a temporary one by default."""

    def run(self) -> int:
        """Measure take by take, print, write."""
        path, device = find_weights(self.weights), pick_device("auto")
        network = read_paper(path).network.to(device)
        if network.flow is None:
            raise WeightsError(f"{self.weights}: no flow head in it; train one with `quest train --stage 2`")
        about = {"weights_hash": file_hash(path), "moved": MOVED, "moving": MOVING}
        with nullcontext(self.cache) if self.cache else tempfile.TemporaryDirectory() as folder:
            features = FeatureCache(Path(folder), network.encoder)

            def judge(store: TakeStore, name: str, part: SplitPart) -> list[FlowRecord]:
                list(features.build(store, [name], device=device))
                info, records = store.infos()[name], list[FlowRecord]()
                take = {key: getattr(info, key) for key in ("object_id", "source", "suite", "level")} | {"take": name}
                for view, stride in product(features.views([name]), self.stride):
                    flow = flow_errors(network, view, stride=stride, device=device)
                    if flow is not None:
                        records += records_of(flow, view=view.name, part=part, stride=stride, **take)
                return records

            return self.measure(judge, flow_rows, about)


if __name__ == "__main__":
    raise SystemExit(tyro.cli(SceneFlow).run())
