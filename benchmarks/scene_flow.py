"""Measure the flow head of the published network: EPE3D beside zero flow and differences of lifted points.

    python benchmarks/scene_flow.py --takes STORE --weights FILE --out benchmarks/results/scene_flow/validation.json

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
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from jaxtyping import Bool, Float
from rich import box
from rich.console import Console
from rich.table import Table
from torch import Tensor

from quest.data.provenance import combined_hash, file_hash
from quest.data.store import TakeStore
from quest.errors import ConfigError, WeightsError
from quest.evaluation.bootstrap import Value, draw_objects, mean_value
from quest.evaluation.metrics import Sums
from quest.evaluation.protocols import START_FRAMES
from quest.evaluation.report import provenance, shown, write_report
from quest.evaluation.selection import select_takes
from quest.model.frames import FrameBatch
from quest.model.weights import find_weights
from quest.paper.network import PaperNetwork, read_paper
from quest.paper.objective import PaperStageOne
from quest.track.tracker import pick_device
from quest.train.feature_cache import CachedView, FeatureCache
from quest.train.plan import WindowPlan
from quest.train.settings import WindowConfig
from quest.train.windows import WindowSampler, WindowTruth

ANSWERS = ("head", "zero", "lifted", "lifted-truth")
READINGS = ("all", "moved", "moving")
"""All entities; those that are at some time more than 0.1 from rest; and the steps of those above 0.005 long."""
MOVED, MOVING = 0.1, 0.005


@dataclass(frozen=True)
class FlowRecord:
    """Errors of one entity in one view, summed over the frames that have a next one.

    Attributes:
        take: name of the take.
        view: name of the prepared view.
        object_id: the object.
        part: part of the object split.
        source: ``partnet-mobility`` or ``procedural``.
        suite: of the simulator.
        level: how many joints move one after the other.
        stride: frames between the frames of a window.
        moved: whether the entity is at some time more than 0.1 from rest.
        total: sum of errors per answer, normalised units.
        count: frames.
        moving_total: the same over steps that are longer than 0.005.
        moving_count: how many those are.
    """

    take: str
    view: str
    object_id: str
    part: str
    source: str
    suite: str
    level: int
    stride: int
    moved: bool
    total: dict[str, float]
    count: int
    moving_total: dict[str, float]
    moving_count: int


@dataclass(frozen=True)
class FlowRow:
    """EPE3D of takes that go together.

    Attributes:
        part: part of the object split.
        source: ``partnet-mobility`` or ``procedural``.
        suite: of the simulator.
        level: how many joints move one after the other.
        stride: frames between the frames of a window, and to the one that is asked for.
        reading: of :data:`READINGS`.
        objects: how many.
        takes: how many.
        entities: how many (take, view, entity).
        epe: EPE3D per answer, normalised units.
    """

    part: str
    source: str
    suite: str
    level: int
    stride: int
    reading: str
    objects: int
    takes: int
    entities: int
    epe: dict[str, Value]


@dataclass(frozen=True)
class ViewFlow:
    """Errors in one view.

    Attributes:
        error: per answer, normalised units; NaN where there is nothing to judge.
        length: true displacement, normalised units.
        scored: entities that are seen where slots are matched.
        moved: entities that are at some time more than 0.1 from rest.
    """

    error: dict[str, Float[np.ndarray, "T K"]]
    length: Float[np.ndarray, "T K"]
    scored: Bool[np.ndarray, " K"]
    moved: Bool[np.ndarray, " K"]


def flow_errors(
    network: PaperNetwork, view: CachedView, *, stride: int, device: torch.device, batch: int = 8
) -> ViewFlow | None:
    """Errors of all answers in one view; None where no entity is seen in the first frames, or no frame has a next one.

    Args:
        network: with a flow head, in evaluation mode, on the device.
        view: prepared with the network's encoder.
        stride: frames between the frames of a window.
        device: where to compute.
        batch: windows at a time.

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
    """One record per scored entity.

    Args:
        flow: errors in a view.
        subject: the first eight fields of a record.
    """
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


def flow_rows(records: Sequence[FlowRecord], *, resamples: int, seed: int) -> tuple[FlowRow, ...]:
    """Rows per part, source, suite, level, stride and reading.

    Args:
        records: of one network.
        resamples: of the bootstrap over objects.
        seed: of the bootstrap; every row draws from a generator of its own.
    """
    groups: dict[tuple, list[FlowRecord]] = defaultdict(list)
    for r in records:
        groups[(r.part, r.source, r.suite, r.level, r.stride)].append(r)
    rows = []
    for key in sorted(groups):
        for reading in READINGS:
            chosen = [r for r in groups[key] if reading == "all" or r.moved]
            row = _row(key, reading, chosen, resamples=resamples, seed=seed)
            rows += [] if row is None else [row]
    return tuple(rows)


def _row(key: tuple, reading: str, chosen: list[FlowRecord], *, resamples: int, seed: int) -> FlowRow | None:
    moving = reading == "moving"
    count = np.array([float(r.moving_count if moving else r.count) for r in chosen])
    if not count.sum():
        return None
    names = sorted({r.object_id for r in chosen})
    owner = np.array([names.index(r.object_id) for r in chosen])
    draws = draw_objects(len(names), resamples=resamples, generator=np.random.default_rng(seed))
    epe = {}
    for answer in ANSWERS:
        total = np.array([(r.moving_total if moving else r.total)[answer] for r in chosen])
        value = mean_value(Sums(total, count), owner, draws)
        assert value is not None
        epe[answer] = value
    part, source, suite, level, stride = key
    return FlowRow(
        part=part,
        source=source,
        suite=suite,
        level=level,
        stride=stride,
        reading=reading,
        objects=len(names),
        takes=len({r.take for r in chosen}),
        entities=int((count > 0).sum()),
        epe=epe,
    )


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
class SceneFlow:
    """EPE3D of weights with a flow head, per source, suite, level and stride."""

    takes: str
    """Folder of the take store; takes with every frame."""
    weights: str
    """Name or file of weights with a flow head (quest train --stage 2)."""
    split: tuple[Literal["train", "validation", "test", "unlisted"], ...] = ("validation",)
    """Parts of the object split."""
    level: tuple[int, ...] = ()
    """Levels; all by default."""
    objects: tuple[str, ...] = ()
    """Object ids; all by default."""
    stride: tuple[int, ...] = (1, 6)
    """Frames between the frames of a window, and to the one that is asked for."""
    cache: Path | None = None
    """Folder of the feature cache; a temporary one by default."""
    resamples: int = 1000
    """Of the bootstrap over objects."""
    seed: int = 0
    """Of the bootstrap."""
    out: Path | None = None
    """Result file."""

    def run(self) -> int:
        """Measure take by take, print, write."""
        path, device = find_weights(self.weights), pick_device("auto")
        network = read_paper(path).network.to(device)
        if network.flow is None:
            raise WeightsError(f"{self.weights}: no flow head in it; train one with `quest train --stage 2`")
        store, console = TakeStore(self.takes), Console(width=170, highlight=False)
        chosen = select_takes(store.infos(), split=self.split, levels=self.level, objects=self.objects)
        about = self._about(path, combined_hash((name, store.data_hash(name)) for name in chosen))
        records: list[FlowRecord] = []
        rows: tuple[FlowRow, ...] = ()
        with nullcontext(self.cache) if self.cache else tempfile.TemporaryDirectory() as folder:
            features = FeatureCache(Path(folder), network.encoder)
            for i, (name, part) in enumerate(chosen.items(), start=1):
                list(features.build(store, [name], device=device))
                info = store.infos()[name]
                for view in features.views([name]):
                    for stride in self.stride:
                        flow = flow_errors(network, view, stride=stride, device=device)
                        if flow is not None:
                            records += records_of(
                                flow,
                                take=name,
                                view=view.name,
                                object_id=info.object_id,
                                part=part,
                                source=info.source,
                                suite=info.suite,
                                level=info.level,
                                stride=stride,
                            )
                rows = flow_rows(records, resamples=self.resamples, seed=self.seed)
                console.print(f"{i}/{len(chosen)} {name}: {len(records)} records so far")
                if self.out is not None:
                    done = {"takes_done": i, "complete": i == len(chosen), "rows": [asdict(row) for row in rows]}
                    write_report(about | done, self.out)
        console.print(_table(rows))
        return 0

    def _about(self, path: Path, data_hash: str) -> dict[str, Any]:
        return provenance() | {
            "weights": self.weights,
            "weights_hash": file_hash(path),
            "data_hash": data_hash,
            "moved": MOVED,
            "moving": MOVING,
            "resamples": self.resamples,
            "seed": self.seed,
        }


def _table(rows: tuple[FlowRow, ...]) -> Table:
    table = Table(
        title="EPE3D, normalised units per step",
        box=box.SIMPLE_HEAD,
        caption=f"95 % bootstrap over objects; moved: more than {MOVED} from rest at some time; moving: of these, "
        f"steps longer than {MOVING}",
    )
    for heading in ("objects", "suite", "L", "stride", "reading", "objects/takes/entities", *ANSWERS):
        table.add_column(heading, justify="left" if heading in ("objects", "suite", "reading") else "right")
    for row in rows:
        table.add_row(
            f"{row.source}, {row.part}",
            row.suite,
            str(row.level),
            str(row.stride),
            row.reading,
            f"{row.objects}/{row.takes}/{row.entities}",
            *(shown(row.epe[answer], decimals=4) for answer in ANSWERS),
        )
    return table


if __name__ == "__main__":
    raise SystemExit(tyro.cli(SceneFlow).run())
