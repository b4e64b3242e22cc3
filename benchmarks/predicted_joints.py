"""Measure how well joints are told from predicted tracks, against the simulator's.

    python benchmarks/predicted_joints.py --takes STORE --split validation \
        --out benchmarks/results/predicted_joints.json

Every scored entity is asked for as in the protocol point, alarms are off. Moved entities are judged at the first frame
in which their true joint has gone 45 degrees or 15 cm from rest, and at the end of the take. The result file is written
anew after each take, and says until the last one that it is not complete.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from jaxtyping import Float, Float32
from rich import box
from rich.console import Console
from rich.table import Table

import quest
from quest.data.provenance import combined_hash
from quest.data.store import TakeStore
from quest.evaluation.bootstrap import Value, draw_objects, mean_value, median_value
from quest.evaluation.metrics import Sums
from quest.evaluation.protocols import first_visible
from quest.evaluation.report import provenance, shown, write_report
from quest.evaluation.selection import select_takes
from quest.filter.joints import Joint, JointKind
from quest.track import StreamState, Tracker
from quest.types import Query, Take

FAR = {JointKind.REVOLUTE: float(np.radians(45)), JointKind.PRISMATIC: 0.15}
"""A joint is judged when it has gone this far from rest: radians, metres."""

Moment = Literal["far", "end"]
NONE = "none"
"""What is said where there is no joint."""


@dataclass(frozen=True)
class JointAnswer:
    """What a tracker said of the joint of one moved entity in one view.

    Attributes:
        take: name of the take.
        view: index of the view.
        entity: the entity's name.
        object_id: the object.
        part: part of the object split.
        source: ``partnet-mobility`` or ``procedural``.
        suite: of the simulator.
        level: how many joints move one after the other.
        moment: ``far``, the first frame where the true joint has gone as far as :data:`FAR`, or ``end``, the last one.
        frame: that frame.
        kind: true kind.
        said: the kind that was said; :data:`NONE` without a joint.
        axis_error_deg: angle between the said and the true axis as lines; None without a moving joint.
    """

    take: str
    view: int
    entity: str
    object_id: str
    part: str
    source: str
    suite: str
    level: int
    moment: Moment
    frame: int
    kind: str
    said: str
    axis_error_deg: float | None

    @property
    def right(self) -> bool:
        """Whether the kind is."""
        return self.said == self.kind


@dataclass(frozen=True)
class JointRow:
    """Answers of one kind of joint at one moment.

    Attributes:
        part: part of the object split.
        source: ``partnet-mobility`` or ``procedural``.
        suite: of the simulator.
        kind: true kind.
        moment: when.
        levels: of the takes.
        objects: how many.
        takes: how many.
        answers: how many (take, view, entity).
        without: answers without a joint.
        static: answers that say it does not move.
        kind_right: share whose kind is right; without a joint and static count as wrong.
        axis_error_deg: median over those whose kind is right; None without any.
        axis_p90_deg: their 90 % quantile.
    """

    part: str
    source: str
    suite: str
    kind: str
    moment: Moment
    levels: tuple[int, ...]
    objects: int
    takes: int
    answers: int
    without: int
    static: int
    kind_right: Value | None
    axis_error_deg: Value | None
    axis_p90_deg: float | None


def judge_view(tracker: Tracker, take: Take, view: int, *, part: str) -> tuple[JointAnswer, ...]:
    """Track a view as the protocol ``point`` does, alarms off, and judge the joints of the entities that move.

    Args:
        tracker: it says joints.
        take: with ground truth.
        view: index of the view.
        part: part of the object split.
    """
    truth = take.views[view]
    scored, first = first_visible(truth.visible, take.tracked)
    moments = moments_of(take)
    if not set(scored.tolist()) & moments.keys():
        return ()
    queries = [
        Query.point(int(t), float(truth.uv_px[t, e, 0]), float(truth.uv_px[t, e, 1]), name=f"query-{k}")
        for k, (e, t) in enumerate(zip(scored, first, strict=True))
    ]
    stream = tracker.stream(truth.clip.camera, queries, alpha=None)
    answers = []
    for t in range(len(take)):
        frame = truth.clip.frame(t)
        state = stream.step(frame.rgb, frame.depth_m, frame.stamp_s, frame.cam_from_world)
        for k, entity in enumerate(scored.tolist()):
            for moment in moments.get(entity, {}).get(t, ()):
                answers.append(_answer(take, view, entity, joint_of(state, k), moment, t, part))
    return tuple(answers)


def moments_of(take: Take) -> dict[int, dict[int, tuple[Moment, ...]]]:
    """When to judge each entity that moves with a joint of its own: moments by frame by entity.

    An entity that another joint carries along, while its own stays, is left out; so is ``far`` where the joint never
    goes that far.
    """
    found: dict[int, dict[int, tuple[Moment, ...]]] = {}
    travel = np.abs(take.joint_position - take.joint_position[:1])
    for e in take.tracked[take.moved[take.tracked]].tolist():
        joint = take.info.entities[e].joint
        if joint not in take.info.moved_joints:
            continue
        last = len(take) - 1
        far = np.flatnonzero(travel[:, joint] >= FAR[JointKind(take.info.joints[joint].kind)])
        found[e] = {last: ("end",)}
        if len(far):
            at = int(far[0])
            found[e][at] = ("far", *found[e].get(at, ()))
    return found


def joint_of(state: StreamState, query: int) -> Joint | None:
    """The joint of a query by its number; None where it has none, or has not bound."""
    return state.joint[state.query.index(query)] if query in state.query else None


def axis_error_deg(said: Float[np.ndarray, "3"], true: Float32[np.ndarray, "3"]) -> float:
    """Angle between two axes as lines, 0 to 90 degrees.

    Args:
        said: unit direction.
        true: unit direction.
    """
    cross, dot = np.linalg.norm(np.cross(said, true.astype(np.float64))), abs(float(said @ true))
    return float(np.degrees(np.arctan2(cross, dot)))


def _answer(
    take: Take, view: int, entity: int, joint: Joint | None, moment: Moment, frame: int, part: str
) -> JointAnswer:
    info = take.info
    own = info.entities[entity].joint
    moving = joint is not None and joint.kind is not JointKind.STATIC
    return JointAnswer(
        take=info.name,
        view=view,
        entity=info.entities[entity].name,
        object_id=info.object_id,
        part=part,
        source=info.source,
        suite=info.suite,
        level=info.level,
        moment=moment,
        frame=frame,
        kind=info.joints[own].kind,
        said=NONE if joint is None else joint.kind.value,
        axis_error_deg=axis_error_deg(joint.axis, take.joint_axis[frame, own, 3:]) if joint and moving else None,
    )


def joint_rows(answers: Sequence[JointAnswer], *, resamples: int, seed: int) -> tuple[JointRow, ...]:
    """Rows per part, source, suite, true kind and moment, levels together.

    Args:
        answers: of one tracker.
        resamples: of the bootstrap over objects.
        seed: of the bootstrap; every row draws from a generator of its own.
    """
    groups: dict[tuple, list[JointAnswer]] = defaultdict(list)
    for a in answers:
        groups[(a.part, a.source, a.suite, a.kind, a.moment)].append(a)
    return tuple(_row(key, groups[key], resamples=resamples, seed=seed) for key in sorted(groups, reverse=True))


def _row(key: tuple, group: list[JointAnswer], *, resamples: int, seed: int) -> JointRow:
    names = sorted({a.object_id for a in group})
    draws = draw_objects(len(names), resamples=resamples, generator=np.random.default_rng(seed))
    owner = np.array([names.index(a.object_id) for a in group])
    right = np.array([a.right for a in group])
    error = np.array([np.nan if a.axis_error_deg is None else a.axis_error_deg for a in group])
    part, source, suite, kind, moment = key
    return JointRow(
        part=part,
        source=source,
        suite=suite,
        kind=kind,
        moment=moment,
        levels=tuple(sorted({a.level for a in group})),
        objects=len(names),
        takes=len({a.take for a in group}),
        answers=len(group),
        without=sum(a.said == NONE for a in group),
        static=sum(a.said == JointKind.STATIC for a in group),
        kind_right=mean_value(Sums(right.astype(np.float64), np.ones(len(right))), owner, draws),
        axis_error_deg=median_value(error[right], owner[right], draws),
        axis_p90_deg=float(np.quantile(error[right], 0.9)) if right.any() else None,
    )


@dataclass(frozen=True)
class PredictedJoints:
    """Shares of right kinds and axis errors of the tracker's joints."""

    takes: str
    """Folder of the take store."""
    split: tuple[Literal["train", "validation", "test", "unlisted"], ...] = ("validation",)
    """Parts of the object split."""
    level: tuple[int, ...] = ()
    """Levels; all by default."""
    objects: tuple[str, ...] = ()
    """Object ids; all by default."""
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
        store, console = TakeStore(self.takes), Console(width=170, highlight=False)
        chosen = select_takes(store.infos(), split=self.split, levels=self.level, objects=self.objects)
        tracker = quest.load(self.weights)
        about = self._about(tracker, combined_hash((name, store.data_hash(name)) for name in chosen))
        answers: list[JointAnswer] = []
        rows: tuple[JointRow, ...] = ()
        for i, (name, part) in enumerate(chosen.items(), start=1):
            take = store.read(name)
            for view in range(len(take.views)):
                answers += judge_view(tracker, take, view, part=part)
            rows = joint_rows(answers, resamples=self.resamples, seed=self.seed)
            console.print(f"{i}/{len(chosen)} {name}: {len(answers)} answers so far")
            if self.out is not None:
                done = {"takes_done": i, "complete": i == len(chosen), "rows": [asdict(row) for row in rows]}
                write_report(about | done | {"answers": [asdict(a) for a in answers]}, self.out)
        console.print(_table(rows))
        return 0

    def _about(self, tracker: Tracker, data_hash: str) -> dict[str, Any]:
        return provenance() | {
            "weights": self.weights,
            "weights_hash": tracker.weights_hash,
            "data_hash": data_hash,
            "far_deg": float(np.degrees(FAR[JointKind.REVOLUTE])),
            "far_m": FAR[JointKind.PRISMATIC],
            "resamples": self.resamples,
            "seed": self.seed,
        }


def _table(rows: tuple[JointRow, ...]) -> Table:
    table = Table(
        title="joints from predicted tracks",
        box=box.SIMPLE_HEAD,
        caption="95 % bootstrap over objects; axis: median where the kind is right; far: the first frame at 45 degrees "
        "or 15 cm",
    )
    headings = ("objects", "suite", "joint", "when", "objects/takes/answers", "none", "static", "kind right %")
    for heading in (*headings, "axis error, degrees", "p90"):
        table.add_column(heading, justify="left" if heading in headings[:4] else "right")
    for row in rows:
        table.add_row(
            f"{row.source}, {row.part}",
            row.suite,
            row.kind,
            row.moment,
            f"{row.objects}/{row.takes}/{row.answers}",
            str(row.without),
            str(row.static),
            shown(row.kind_right, factor=100, decimals=0),
            shown(row.axis_error_deg, decimals=1),
            "-" if row.axis_p90_deg is None else f"{row.axis_p90_deg:.1f}",
        )
    return table


if __name__ == "__main__":
    raise SystemExit(tyro.cli(PredictedJoints).run())
