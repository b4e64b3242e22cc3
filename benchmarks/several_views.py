"""Measure what several cameras give over one: takes of several views, each view alone, their mean, and fused.

    python -m benchmarks.several_views --takes STORE --out benchmarks/results/several_views.json

Each view alone is asked as in the protocol point, for what it sees in the first frames. The fused tracks are asked for
each entity once, in the first view that sees it; or in each view that does, as the single views and their mean are. The
result file is written anew after each take, and says until the last one that it is not complete.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from operator import attrgetter
from typing import Any

import numpy as np
import tyro
from jaxtyping import Bool, Float
from scipy.stats import chi2

import quest
from benchmarks.study import Study
from quest.data.split import SplitPart
from quest.data.store import TakeStore
from quest.evaluation.bootstrap import Pool
from quest.evaluation.metrics import distance, identity
from quest.evaluation.protocols import first_visible, true_queries
from quest.filter.view import View
from quest.track import Tracker
from quest.track.fusion import place_covariance
from quest.track.views import track_views
from quest.types import State, Take, Tracks

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


def record_of(take: Take, source: str, entity: int, first: int, point: np.ndarray, lost: np.ndarray) -> Record:
    """One answer from the frame ``first`` of its query on: points in metres, [T, 3], and where it says lost."""
    info, true, own = take.info, take.point_world[:, entity], np.searchsorted(take.tracked, [entity])
    points, unit = point[:, None].astype(np.float64), info.half_diagonal_m
    nearest = identity(points, take.point_world[:, take.tracked], own, half_diagonal_m=unit)
    return Record(
        source,
        info.name,
        info.object_id,
        info.entities[entity].name,
        bool(take.moved[entity]),
        distance(point, true, half_diagonal_m=unit)[first:],
        100 * np.linalg.norm(point - true, axis=-1)[first:],
        nearest[first:, 0] == own[0],
        lost[first:],
    )


def judge(tracker: Tracker, take: Take) -> tuple[list[Record], list[float], list[float]]:
    """All records of a take; distances in centimetres of two views' points, and in standard deviations squared."""
    records, clips = list[Record](), [view.clip for view in take.views]
    seen = [dict(zip(*map(np.ndarray.tolist, first_visible(v.visible, take.tracked)), strict=True)) for v in take.views]
    singles = [
        tracker.track(clip, true_queries(take.views[v], seen[v], seen[v].values())) for v, clip in enumerate(clips)
    ]
    entities = sorted(set().union(*seen))
    every = [(e, v) for e in entities for v in range(len(clips)) if e in seen[v]]
    once = [next((e, v) for e, v in every if e == entity) for entity in entities]
    for source, asked in ((FUSED_ONE, once), (FUSED_ALL, every)):
        queries = [true_queries(take.views[v], [e], [seen[v][e]])[0] for e, v in asked]
        fused = track_views(tracker, clips, queries, view=[v for _, v in asked]).whole
        for k, e in enumerate(entities):
            first = min(seen[v][e] for entity, v in asked if entity == e)
            records.append(record_of(take, source, e, first, fused.point_world[:, k], _lost(fused, k)))
    for e in entities:
        alone = [(u, singles[u], list(seen[u]).index(e)) for u in range(len(clips)) if e in seen[u]]
        each = [record_of(take, f"view {u}", e, seen[u][e], t.point_world[:, i], _lost(t, i)) for u, t, i in alone]
        best = min(each, key=lambda record: record.error.mean())
        records += [*each, *(replace(record, source=ANY) for record in each), replace(best, source=BEST)]
        points = np.stack([t.point_world[:, i] for _, t, i in alone])
        doubt = np.stack([t.lost_p[:, i] for _, t, i in alone if t.lost_p is not None])
        first, lost = max(seen[u][e] for u, *_ in alone), doubt.mean(axis=0) > 0.5
        records.append(record_of(take, MEAN, e, first, np.nanmean(points, axis=0), lost))
    return records, *_apart(tracker, take, singles, seen)


def _lost(tracks: Tracks, k: int) -> Bool[np.ndarray, " T"]:
    return tracks.state[:, k] == State.LOST


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


def rows_of(records: Sequence[Record], *, resamples: int, seed: int) -> list[dict[str, Any]]:
    """Rows by source and reading: ``all`` entities, or those that ``moved``."""
    rows = []
    for reading, source in product(("all", "moved"), sorted({record.source for record in records})):
        group = [r for r in records if r.source == source and (r.moved or reading == "all")]
        if group:
            pool = Pool(group, attrgetter("object_id"), resamples=resamples, seed=seed)
            row = {"source": source, "reading": reading, "objects": pool.objects, "tracks": len(group)}
            row |= {
                "error_median": pool.median(lambda r: r.error),
                "error_mean": pool.mean(lambda r: r.error.sum(), lambda r: len(r.error)),
                "error_median_cm": pool.median(lambda r: r.error_cm),
                "right_identity": pool.mean(lambda r: r.right.sum(), lambda r: len(r.right)),
                # Of the frames with a wrong identity, and with the right one, those that are said to be lost.
                "loss_said": pool.mean(lambda r: (r.lost & ~r.right).sum(), lambda r: (~r.right).sum()),
                "false_loss": pool.mean(lambda r: (r.lost & r.right).sum(), lambda r: r.right.sum()),
            }
            rows.append(row)
    return rows


@dataclass(frozen=True)
class SeveralViews(Study):
    """Errors, identities and said losses of single views, their mean, and fused views."""

    split: tuple[SplitPart, ...] = ("train", "validation", "test", "unlisted")
    """Parts of the object split."""

    def run(self) -> int:
        """Track take by take, print, write."""
        tracker = quest.load(self.weights)
        apart_cm: list[float] = []
        squared: list[float] = []

        def judged(store: TakeStore, name: str, part: SplitPart) -> list[Record]:
            records, far, deviations = judge(tracker, store.read(name))
            apart_cm.extend(far)
            squared.extend(deviations)
            return records

        def agreement(records: object) -> dict[str, Any]:
            """How far the points of two views are apart where both have the right identity and say so."""
            within = float(np.mean(np.array(squared) < chi2.ppf(0.95, df=3)))  # what their assumed noise gives
            median, p90 = np.quantile(apart_cm, (0.5, 0.9)).tolist()
            return {"agreement": {"pairs": len(apart_cm), "median_cm": median, "p90_cm": p90, "within_95": within}}

        return self.measure(judged, rows_of, {"weights_hash": tracker.weights_hash}, agreement)


if __name__ == "__main__":
    raise SystemExit(tyro.cli(SeveralViews).run())
