"""Measure what several cameras give over one: takes of several views, each view alone, their mean, and fused.

    python benchmarks/several_views.py --takes STORE --out benchmarks/results/several_views.json

Each view alone is asked as in the protocol point, for what it sees in the first frames. The fused tracks are asked for
each entity once, in the first view that sees it; or in each view that does, as the single views and their mean are. The
result file is written anew after each take, and says until the last one that it is not complete.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from itertools import combinations
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Bool, Float, Int
from rich import box
from rich.console import Console
from rich.table import Table
from scipy.stats import chi2

import quest
from quest.data.provenance import combined_hash
from quest.data.store import TakeStore
from quest.evaluation.bootstrap import Value, draw_objects, mean_value, median_value
from quest.evaluation.metrics import Sums, distance, identity
from quest.evaluation.protocols import first_visible
from quest.evaluation.report import provenance, shown, write_report
from quest.filter.view import View
from quest.track import Tracker
from quest.track.fusion import place_covariance
from quest.track.views import track_views
from quest.types import Query, State, Take, Tracks

BEST, MEAN, ANY = "best view (chosen by the truth)", "mean of views", "any view"
FUSED_ONE, FUSED_ALL = "fused, one click", "fused, a click in each view"


@dataclass(frozen=True)
class Record:
    """The answer to one entity of a take."""

    source: str
    """A view, or how views were put together."""
    take: str
    object_id: str
    entity: str
    moved: bool
    """Whether the entity moves in the take."""
    error: Float[np.ndarray, " T"]
    """Normalised; 1 where there is no answer."""
    error_cm: Float[np.ndarray, " T"]
    """Centimetres; NaN where there is no answer."""
    right: Bool[np.ndarray, " T"]
    """Whether the answer is nearest to its own entity, and near."""
    lost: Bool[np.ndarray, " T"]
    """Whether it says that it is lost."""


@dataclass(frozen=True)
class Row:
    """Records of one source and reading; values with intervals over objects."""

    source: str
    reading: str
    """``all``, or ``moved``: entities that move in the take."""
    objects: int
    tracks: int
    error_median: Value | None
    """Normalised."""
    error_mean: Value | None
    error_median_cm: Value | None
    right_identity: Value | None
    """Share of frames."""
    loss_said: Value | None
    """Share of the frames with a wrong identity that are said to be lost."""
    false_loss: Value | None
    """Share of the frames with the right identity that are said to be lost."""


@dataclass(frozen=True)
class Agreement:
    """How far the points of two views are apart where both have the right identity and say so."""

    pairs: int
    """Of frames, entities and views."""
    median_cm: float
    p90_cm: float
    within_95: float
    """Share within what the assumed noise of both gives in 95 % of the cases."""


@dataclass
class _Judge:
    """Collects records of one take."""

    take: Take
    records: list[Record] = field(default_factory=list)

    def add(self, source: str, entity: int, first: int, point: np.ndarray, lost: np.ndarray) -> Record:
        """One answer from its first frame on.

        Args:
            source: whose.
            entity: index in the take.
            first: frame of the query.
            point: T x 3, metres.
            lost: T, whether it says so.
        """
        take, info = self.take, self.take.info
        own = np.searchsorted(take.tracked, [entity])
        true = take.point_world[:, entity]
        nearest = identity(
            point[:, None].astype(np.float64), take.point_world[:, take.tracked], own,
            half_diagonal_m=info.half_diagonal_m,
        )  # fmt: skip
        record = Record(
            source,
            info.name,
            info.object_id,
            info.entities[entity].name,
            bool(take.moved[entity]),
            distance(point, true, half_diagonal_m=info.half_diagonal_m)[first:],
            100 * np.linalg.norm(point - true, axis=-1)[first:],
            nearest[first:, 0] == own[0],
            lost[first:],
        )
        self.records.append(record)
        return record


def judge(tracker: Tracker, take: Take) -> tuple[list[Record], list[float], list[float]]:
    """All records of a take; distances in centimetres of two views' points, and in standard deviations squared."""
    judged, clips = _Judge(take), [view.clip for view in take.views]
    seen = [dict(zip(*map(np.ndarray.tolist, first_visible(v.visible, take.tracked)), strict=True)) for v in take.views]
    singles = [tracker.track(clip, _queries(take, v, seen[v])) for v, clip in enumerate(clips)]
    entities = sorted(set().union(*seen))
    every = [(e, v) for e in entities for v in range(len(clips)) if e in seen[v]]
    once = [next((e, v) for e, v in every if e == entity) for entity in entities]
    for source, asked in ((FUSED_ONE, once), (FUSED_ALL, every)):
        queries = [_queries(take, v, {e: seen[v][e]})[0] for e, v in asked]
        fused = track_views(tracker, clips, queries, view=[v for _, v in asked]).whole
        for k, e in enumerate(entities):
            first = min(seen[v][e] for entity, v in asked if entity == e)
            judged.add(source, e, first, fused.point_world[:, k], _lost(fused, k))
    for e in entities:
        alone = [(u, singles[u], list(seen[u]).index(e)) for u in range(len(clips)) if e in seen[u]]
        each = [judged.add(f"view {u}", e, seen[u][e], t.point_world[:, i], _lost(t, i)) for u, t, i in alone]
        judged.records += [_renamed(record, ANY) for record in each]
        judged.records.append(_renamed(min(each, key=lambda record: record.error.mean()), BEST))
        points = np.stack([t.point_world[:, i] for _, t, i in alone])
        doubt = np.stack([t.lost_p[:, i] for _, t, i in alone if t.lost_p is not None])
        judged.add(MEAN, e, max(seen[u][e] for u, *_ in alone), np.nanmean(points, axis=0), doubt.mean(axis=0) > 0.5)
    return judged.records, *_apart(tracker, take, singles, seen)


def _queries(take: Take, view: int, seen: dict[int, int]) -> list[Query]:
    truth = take.views[view]
    return [Query.point(t, *map(float, truth.uv_px[t, e]), name=f"query-{e}") for e, t in seen.items()]


def _lost(tracks: Tracks, k: int) -> Bool[np.ndarray, " T"]:
    return tracks.state[:, k] == State.LOST


def _renamed(record: Record, source: str) -> Record:
    return Record(**{**vars(record), "source": source})


def _apart(
    tracker: Tracker, take: Take, singles: Sequence[Tracks], seen: Sequence[dict[int, int]]
) -> tuple[list[float], list[float]]:
    """Distances of the points of two views of one entity that both see and have right."""
    gate_m, apart_cm, squared = 0.1 * take.info.half_diagonal_m, [], []
    for u, v in combinations(range(len(singles)), 2):
        for e in seen[u].keys() & seen[v].keys():
            places = []
            for w in (u, v):
                k, clip, tracks = list(seen[w]).index(e), take.views[w].clip, singles[w]
                right = np.linalg.norm(tracks.point_world[:, k] - take.point_world[:, e], axis=-1) < gate_m
                view = View(clip.camera.matrix, clip.cam_from_world[0], None)
                point = tracks.point_world[:, k].astype(np.float64)
                covariance = place_covariance(point, tracks.visible[:, k], view, tracker.noise)
                places.append((point, covariance, right & tracks.visible[:, k] & ~_lost(tracks, k)))
            both = places[0][2] & places[1][2]
            off = (places[0][0] - places[1][0])[both]
            spread = (places[0][1] + places[1][1])[both]
            apart_cm += (100 * np.linalg.norm(off, axis=-1)).tolist()
            squared += np.einsum("ni,ni->n", off, np.linalg.solve(spread, off[..., None])[..., 0]).tolist()
    return apart_cm, squared


def rows_of(records: Sequence[Record], *, resamples: int, seed: int) -> list[Row]:
    """Rows by source and reading."""
    rows = []
    for reading in ("all", "moved"):
        for source in sorted({record.source for record in records}):
            group = [r for r in records if r.source == source and (r.moved or reading == "all")]
            if group:
                rows.append(_row(source, reading, group, resamples=resamples, seed=seed))
    return rows


def _row(source: str, reading: str, group: list[Record], *, resamples: int, seed: int) -> Row:
    names = sorted({record.object_id for record in group})
    draws = draw_objects(len(names), resamples=resamples, generator=np.random.default_rng(seed))
    owner: Int[np.ndarray, " N"] = np.array([names.index(record.object_id) for record in group])
    frame_owner = np.repeat(owner, [len(record.error) for record in group])

    def share(counts: list[tuple[int, int]]) -> Value | None:
        total, count = np.array(counts, np.float64).T
        return mean_value(Sums(total, count), owner, draws)

    return Row(
        source=source,
        reading=reading,
        objects=len(names),
        tracks=len(group),
        error_median=median_value(np.concatenate([r.error for r in group]), frame_owner, draws),
        error_mean=mean_value(
            Sums(np.array([r.error.sum() for r in group]), np.array([len(r.error) for r in group], float)), owner, draws
        ),
        error_median_cm=median_value(np.concatenate([r.error_cm for r in group]), frame_owner, draws),
        right_identity=share([(int(r.right.sum()), len(r.right)) for r in group]),
        loss_said=share([(int((r.lost & ~r.right).sum()), int((~r.right).sum())) for r in group]),
        false_loss=share([(int((r.lost & r.right).sum()), int(r.right.sum())) for r in group]),
    )


@dataclass(frozen=True)
class SeveralViews:
    """Errors, identities and said losses of single views, their mean, and fused views."""

    takes: str
    """Folder of a store of takes with several views."""
    weights: str = "quest-s16"
    """Name or file of the weights."""
    resamples: int = 1000
    """Of the bootstrap over objects."""
    seed: int = 0
    """Of the bootstrap."""
    out: Path | None = None
    """Result file."""

    def run(self) -> int:
        """Track take by take, print, write."""
        store, console, tracker = TakeStore(self.takes), Console(width=170, highlight=False), quest.load(self.weights)
        names = store.names()
        about = provenance() | {
            "weights": self.weights,
            "weights_hash": tracker.weights_hash,
            "data_hash": combined_hash((name, store.data_hash(name)) for name in names),
            "resamples": self.resamples,
            "seed": self.seed,
        }
        records: list[Record] = []
        apart_cm: list[float] = []
        squared: list[float] = []
        rows: list[Row] = []
        for i, name in enumerate(names, start=1):
            new, far, deviations = judge(tracker, store.read(name))
            records, apart_cm, squared = records + new, apart_cm + far, squared + deviations
            rows = rows_of(records, resamples=self.resamples, seed=self.seed)
            agreement = Agreement(
                len(apart_cm),
                float(np.median(apart_cm)),
                float(np.quantile(apart_cm, 0.9)),
                float(np.mean(np.array(squared) < chi2.ppf(0.95, df=3))),
            )
            console.print(f"{i}/{len(names)} {name}: {len(records)} records, {agreement}")
            if self.out is not None:
                done = {"takes_done": i, "complete": i == len(names), "agreement": asdict(agreement)}
                write_report(about | done | {"rows": [asdict(row) for row in rows]}, self.out)
        console.print(_table(rows))
        return 0


def _table(rows: Sequence[Row]) -> Table:
    table = Table(title="several views", box=box.SIMPLE_HEAD, caption="95 % bootstrap over objects")
    for heading in ("answer", "reading", "objects/tracks", "median error", "mean error", "median, cm"):
        table.add_column(heading)
    for heading in ("right identity %", "loss said %", "false loss %"):
        table.add_column(heading)
    for row in rows:
        table.add_row(
            row.source,
            row.reading,
            f"{row.objects}/{row.tracks}",
            shown(row.error_median, decimals=3),
            shown(row.error_mean, decimals=3),
            shown(row.error_median_cm, decimals=2),
            *(shown(v, factor=100, decimals=0) for v in (row.right_identity, row.loss_said, row.false_loss)),
        )
    return table


if __name__ == "__main__":
    raise SystemExit(tyro.cli(SeveralViews).run())
