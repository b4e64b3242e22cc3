"""Drift detection as rows: every detector on the same streams, with intervals; the file and the table of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import attrgetter
from pathlib import Path

import numpy as np
from rich import box
from rich.console import Group, RenderableType
from rich.table import Table

from quest.evaluation.bootstrap import LEVEL, Pool, Value
from quest.evaluation.detectors import Detector, Played, one_part, one_per_object, play
from quest.evaluation.drift import (
    augrc,
    calibration_error,
    clopper_pearson,
    delay_of,
    losses,
    quantile,
    ranked_auroc,
)
from quest.evaluation.report import write_report
from quest.evaluation.results import Run
from quest.evaluation.stream_record import StreamRecord
from quest.evaluation.tables import shown
from quest.monitor import Budget

FORMAT = 2
"""Version of the result file."""

TABLE_WIDTH = 170
"""Characters that the table needs."""


@dataclass(frozen=True)
class AlarmRow:
    """Alarms at one alpha."""

    alpha: float
    """Share of loss-free streams that may alarm."""
    alpha_frames: int | None
    """Frames of a stream that alpha is for; None for a whole stream."""
    threshold: float | None
    """In the first block; None where the calibration streams are too few for any."""
    extrapolated: bool
    """Whether it is read off a fitted tail."""
    trials: int
    """Loss-free streams, one per object. Where alpha is for so many frames, one such part of a stream per object, with
    no loss in it or before."""
    false_alarms: int
    """How many of them raised an alarm."""
    low: float | None
    """Lower end of the exact 95 % interval of their share; None without streams."""
    high: float | None
    all_trials: int
    """All loss-free streams or parts, those of one object dependent on each other."""
    all_false_alarms: int
    unclear_trials: int
    """How many of :attr:`trials` are not always right, though never lost."""
    unclear_false_alarms: int
    missed: Value | None
    """Share of judged losses that are missed."""
    early: Value | None
    """Share of judged losses whose query had alarmed before it was ever lost."""
    delay_median: Value | None
    """Frames from the loss to the alarm; a missed loss has an infinite delay, and the value is None where the median is
    infinite or there are no losses."""
    delay_p90: Value | None
    """The same for 90 %."""


@dataclass(frozen=True)
class DriftRow:
    """One detector on one kind of streams."""

    detector: str
    part: str
    source: str
    objects: int
    streams: int
    frames: int
    """(frame, query) pairs that are right or lost."""
    lost_frames: int
    unclear_frames: int
    """Pairs beside these, which are neither."""
    losses: int
    """Queries with a loss that is judged."""
    brief: int
    """Queries that are lost, but never long enough to be judged."""
    auroc: Value | None
    """Per frame, like the next two."""
    augrc: Value | None
    ece: Value | None
    """None where the score is no probability."""
    alarms: tuple[AlarmRow, ...]


def drift_rows(
    detectors: Sequence[Detector],
    records: Sequence[StreamRecord],
    *,
    budgets: Sequence[Budget],
    resamples: int,
    seed: int,
) -> tuple[DriftRow, ...]:
    """Rows per part of the split, source and detector.

    None of the records took part in any calibration of the detectors.
    """
    rows = []
    for part, source in sorted({(r.part, r.source) for r in records}):
        group = [r for r in records if (r.part, r.source) == (part, source)]
        pool = Pool(group, attrgetter("object_id"), resamples=resamples, seed=seed)
        rows += [_row(detector, pool, budgets) for detector in detectors]
    return tuple(rows)


def _row(detector: Detector, pool: Pool[StreamRecord], budgets: Sequence[Budget]) -> DriftRow:
    records, played = pool.records, play(detector, pool.records)
    judged = [r.judged for r in records]
    score = np.concatenate([s[j] for s, j in zip(played.score, judged, strict=True)])
    lost = np.concatenate([r.lost[j] for r, j in zip(records, judged, strict=True)])
    owner = np.repeat(pool.owner, [int(j.sum()) for j in judged])
    rank = np.unique(score, return_inverse=True)[1]

    def area(weight: np.ndarray) -> float:
        return ranked_auroc(rank, lost, weight)

    def risk(weight: np.ndarray) -> float:
        return augrc(area(weight), float((weight * lost).sum() / weight.sum()))

    def error(weight: np.ndarray) -> float:
        return calibration_error(score, lost, weight)

    every = [loss for r in records for loss in losses(r)]
    return DriftRow(
        detector=detector.name,
        part=records[0].part,
        source=records[0].source,
        objects=pool.objects,
        streams=len(records),
        frames=len(lost),
        lost_frames=int(lost.sum()),
        unclear_frames=sum(int((r.watched & ~r.right & ~r.lost).sum()) for r in records),
        losses=sum(loss.lasts for loss in every),
        brief=sum(not loss.lasts for loss in every),
        auroc=_value(area, owner, pool.draws),
        augrc=_value(risk, owner, pool.draws),
        ece=_value(error, owner, pool.draws) if detector.probabilistic else None,
        alarms=tuple(_alarm_row(detector, played, pool, budget) for budget in budgets),
    )


def _value(metric: Callable[[np.ndarray], float], owner: np.ndarray, draws: np.ndarray) -> Value | None:
    """A metric of weighted terms with its percentile interval; None where it is not defined or infinite.

    Args:
        metric: of the weight of each term.
        owner: object of each term.
        draws: how often each object is drawn in each resample.
    """
    mean = metric(np.ones(len(owner))) if len(owner) else math.nan
    if not math.isfinite(mean):
        return None
    if len(np.unique(owner)) < 2:
        return Value(mean, None, None, len(owner))
    drawn = (draw[owner] for draw in draws.astype(np.float64))
    samples = np.array([metric(weight) for weight in drawn if weight.sum() > 0])
    samples = samples[~np.isnan(samples)]
    low, high = (_finite(quantile(samples, share)) for share in ((1.0 - LEVEL) / 2.0, (1.0 + LEVEL) / 2.0))
    return Value(mean, low, high, len(owner))


def _alarm_row(detector: Detector, played: Played, pool: Pool[StreamRecord], budget: Budget) -> AlarmRow:
    records = pool.records
    limits = [detector.limits(len(r), budget) for r in records]
    above = [
        path > np.array([limit.value for limit in own])[:, None] for path, own in zip(played.path, limits, strict=True)
    ]
    parts = [parts_of(len(r), budget.frames) for r in records]
    alarmed = {
        (i, n): bool(above[i][first:last].any())
        for i, r in enumerate(records)
        for n, (first, last) in enumerate(parts[i])
        if not r.lost[:last].any()
    }
    one_each = [(i, one_part(records[i], len(parts[i]))) for i in one_per_object(records)]
    drawn = [place for place in one_each if place in alarmed]
    unclear = [(i, n) for i, n in drawn if (records[i].watched & ~records[i].right)[slice(*parts[i][n])].any()]
    false = sum(alarmed[place] for place in drawn)
    low, high = clopper_pearson(false, len(drawn)) if drawn else (None, None)
    judged = [(i, loss) for i, r in enumerate(records) for loss in losses(r) if loss.lasts]
    delay = np.array([delay_of(loss, above[i][:, loss.query]) for i, loss in judged])
    early = np.array([above[i][: loss.first, loss.query].any() for i, loss in judged], dtype=np.float64)
    owner = pool.owner[[i for i, _ in judged]] if judged else np.zeros(0, int)

    def mean(terms: np.ndarray) -> Value | None:
        return _value(lambda w: float((w * terms).sum() / w.sum()), owner, pool.draws)

    def delay_at(share: float) -> Value | None:
        return _value(lambda w: quantile(delay, share, w), owner, pool.draws)

    first = limits[0][0]
    return AlarmRow(
        alpha=budget.alpha,
        alpha_frames=budget.frames,
        threshold=_finite(first.value),
        extrapolated=first.extrapolated,
        trials=len(drawn),
        false_alarms=false,
        low=low,
        high=high,
        all_trials=len(alarmed),
        all_false_alarms=sum(alarmed.values()),
        unclear_trials=len(unclear),
        unclear_false_alarms=sum(alarmed[place] for place in unclear),
        missed=mean(np.isinf(delay).astype(np.float64)),
        early=mean(early),
        delay_median=delay_at(0.5),
        delay_p90=delay_at(0.9),
    )


def parts_of(frames: int, each: int | None) -> list[tuple[int, int]]:
    """First frame, and frame after the last, of the parts of a stream that alpha is for; the whole where None.

    What is left at the end counts for nothing: it is too short to alarm as often. A stream that is shorter than a part
    counts as one.
    """
    each = frames if each is None else min(each, frames)
    return [(first, first + each) for first in range(0, frames - each + 1, each)]


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def write_drift(rows: Sequence[DriftRow], run: Run, about: str, path: Path) -> None:
    """Write the result file, whole or not at all; ``about`` says what the monitor was calibrated on."""
    write_report({"format": FORMAT, "run": run, "calibration": about, "rows": rows}, path)


def drift_table(rows: Sequence[DriftRow]) -> RenderableType:
    """Rows as tables, one per part of the split and source."""
    tables = []
    headings = ("detector", "AUROC", "AUGRC", "ECE", "α %", "false alarms %", "of", "unclear", "missed %", "early %")
    for (part, source), group in groupby(rows, key=lambda row: (row.part, row.source)):
        own = list(group)
        first = own[0]
        title = (
            f"{source} · {part} objects · {first.objects} objects, {first.streams} streams, {first.frames} frames "
            f"({first.lost_frames} lost; {first.unclear_frames} more unclear), {first.losses} losses "
            f"(and {first.brief} brief)"
        )
        table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
        for heading in (*headings, "delay", "p90"):
            table.add_column(heading, justify="left" if heading == "detector" else "right")
        for row in own:
            scores = (row.detector, shown(row.auroc), shown(row.augrc), shown(row.ece))
            for i, alarm in enumerate(row.alarms):
                table.add_row(*(scores if i == 0 else ("",) * 4), *_alarm_cells(alarm))
        tables.append(table)
    legend = (
        "below or beside each number its 95 % interval: exact for false alarms (one loss-free stream per object, or "
        "part of it where alpha is for so many frames), bootstrap over objects for the others. "
        "unclear: alarms in those of these streams that are not always right, though never lost. "
        "~: threshold from a fitted tail. delay in frames; >: not reached"
    )
    return Group(*tables, legend)


def _alarm_cells(alarm: AlarmRow) -> tuple[str, ...]:
    rate = alarm.false_alarms / max(alarm.trials, 1)
    share = Value(rate, alarm.low, alarm.high, alarm.trials) if alarm.trials else None
    none = "-" if alarm.missed is None else ">"
    frames = "" if alarm.alpha_frames is None else f" in {alarm.alpha_frames}"
    return (
        f"{'~' if alarm.extrapolated else ''}{100 * alarm.alpha:g}{frames}",
        shown(share, factor=100, decimals=1),
        str(alarm.trials),
        f"{alarm.unclear_false_alarms}/{alarm.unclear_trials}",
        shown(alarm.missed, factor=100, decimals=1),
        shown(alarm.early, factor=100, decimals=1),
        shown(alarm.delay_median, decimals=0, none=none),
        shown(alarm.delay_p90, decimals=0, none=none),
    )
