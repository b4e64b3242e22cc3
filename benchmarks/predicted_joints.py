"""Measure how well joints are told from predicted tracks, against the simulator's.

    python -m benchmarks.predicted_joints --takes STORE --split validation \
        --out benchmarks/results/predicted_joints.json

Every scored entity is asked for as in the protocol point, alarms are off. Moved entities are judged at the first frame
in which their true joint has gone 45 degrees or 15 cm from rest, and at the end of the take. The result file is written
anew after each take, and says until the last one that it is not complete.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, Literal

import numpy as np
import tyro
from jaxtyping import Float, Float32

import quest
from benchmarks.study import Study
from quest.data.split import SplitPart
from quest.data.store import TakeStore
from quest.evaluation.bootstrap import Pool
from quest.evaluation.protocols import first_visible, true_queries
from quest.filter.joints import Joint, JointKind
from quest.track import StreamState, Tracker
from quest.types import Take

FAR = {JointKind.REVOLUTE: float(np.radians(45)), JointKind.PRISMATIC: 0.15}
"""A joint is judged when it has gone this far from rest: radians, metres."""

Moment = Literal["far", "end"]
NONE = "none"
"""What is said where there is no joint."""


@dataclass(frozen=True)
class JointAnswer:
    """What a tracker said of the joint of one moved entity in one view."""

    take: str
    view: int
    entity: str
    object_id: str
    part: str
    source: str
    suite: str
    level: int
    moment: Moment
    """``far``, the first frame where the true joint has gone as far as :data:`FAR`, or ``end``, the last one."""
    frame: int
    """That frame."""
    kind: str
    """The true one."""
    said: str
    """The kind that was said; :data:`NONE` without a joint."""
    axis_error_deg: float | None
    """Angle between the said and the true axis as lines; None without a moving joint."""

    @property
    def right(self) -> bool:
        """Whether the kind is."""
        return self.said == self.kind


def judge_view(tracker: Tracker, take: Take, view: int, *, part: str) -> tuple[JointAnswer, ...]:
    """Track a view as the protocol ``point`` does, alarms off, and judge the joints of the entities that move."""
    truth = take.views[view]
    scored, first = first_visible(truth.visible, take.tracked)
    moments = moments_of(take)
    if not set(scored.tolist()) & moments.keys():
        return ()
    stream = tracker.stream(truth.clip.camera, true_queries(truth, scored, first), alpha=None)
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
    """Angle between two unit directions as lines, 0 to 90 degrees."""
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


def joint_rows(answers: Sequence[JointAnswer], *, resamples: int, seed: int) -> list[dict[str, Any]]:
    """Rows per part, source, suite, true kind and moment, levels together.

    ``without`` a joint and ``static`` count as wrong kinds; errors of axes are over answers whose kind is right.
    """
    names = ("part", "source", "suite", "kind", "moment")
    groups: dict[tuple, list[JointAnswer]] = defaultdict(list)
    for answer in answers:
        groups[attrgetter(*names)(answer)].append(answer)
    rows = []
    for key in sorted(groups, reverse=True):
        pool = Pool(groups[key], attrgetter("object_id"), resamples=resamples, seed=seed)
        right = pool.where(attrgetter("right"))
        errors = np.array([a.axis_error_deg for a in right.records], np.float64)
        rows.append(
            dict(zip(names, key, strict=True))
            | {
                "levels": sorted({a.level for a in pool.records}),
                "objects": pool.objects,
                "takes": len({a.take for a in pool.records}),
                "answers": len(pool.records),
                "without": sum(a.said == NONE for a in pool.records),
                "static": sum(a.said == JointKind.STATIC for a in pool.records),
                "kind_right": pool.mean(attrgetter("right")),
                "axis_error_deg": right.median(attrgetter("axis_error_deg")),
                "axis_p90_deg": float(np.quantile(errors, 0.9)) if len(errors) else None,
            }
        )
    return rows


@dataclass(frozen=True)
class PredictedJoints(Study):
    """Shares of right kinds and axis errors of the tracker's joints."""

    def run(self) -> int:
        """Track take by take, print, write."""
        tracker = quest.load(self.weights)

        def judge(store: TakeStore, name: str, part: SplitPart) -> list[JointAnswer]:
            take = store.read(name)
            return [answer for v in range(len(take.views)) for answer in judge_view(tracker, take, v, part=part)]

        far = {"far_deg": float(np.degrees(FAR[JointKind.REVOLUTE])), "far_m": FAR[JointKind.PRISMATIC]}
        about = {"weights_hash": tracker.weights_hash} | far
        return self.measure(judge, joint_rows, about, lambda answers: {"answers": answers})


if __name__ == "__main__":
    raise SystemExit(tyro.cli(PredictedJoints).run())
