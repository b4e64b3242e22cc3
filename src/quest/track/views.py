"""Several cameras that see one scene: one stream per view, and one track of each entity over all of them.

The views share a world, in which their poses are known, and a clock. An entity is asked for in one view, or found in
several. Another view follows it too, from the first frame on in which it sees the entity's place in the world. In every
frame the views' places are fused (:mod:`quest.track.fusion`). A view that has lost the entity is put back to where the
others see it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment
from scipy.special import logit
from scipy.stats import chi2

from quest.errors import ConfigError, InputError
from quest.filter.joints import Joint, JointKind
from quest.filter.noise import Noise
from quest.filter.surfaces import depth_error
from quest.filter.view import View, in_image
from quest.monitor import Alarm
from quest.track.fusion import MOST_VIEWS, Fused, fuse, place_covariance
from quest.track.state import StreamState
from quest.track.stream import WITHHELD_FLAG, coordinate
from quest.track.tracker import DEFAULT_ALPHA, Tracker, collect
from quest.types import Camera, Clip, Frame, Query, State, Tracks

_SURE_P = 0.95
"""How probable a fused place has to be, for a view to be put there."""
_SAME = float(chi2.ppf(0.99, df=3))
"""Squared distance, in standard deviations, up to which what two views found is one entity."""
_MOST_LOG_ODDS = 9.0


@dataclass(frozen=True)
class FusedTracks:
    """Tracks over all views, and those of each."""

    whole: Tracks
    """One per entity, at the times of the first view, whose pixels they are in; ``visible`` where any view sees it."""
    views: tuple[Tracks, ...]
    """Of each view by itself, in its own frames and pixels; queries are in the order of ``whole``."""

    def seen_from(self, view: int, clip: Clip) -> Tracks:
        """The fused tracks in the frames and pixels of a view and its clip, such as for an overlay."""
        own, whole = self.views[view], self.whole
        at = np.abs(whole.stamp_s[:, None] - clip.stamp_s).argmin(axis=0)
        point = whole.point_world[at]
        uv_px = np.stack([_view(clip.camera, clip.frame(t)).project(point[t])[0] for t in range(len(clip))])
        lost, visible = whole.state[at] == State.LOST, own.visible & (whole.state[at] != State.LOST)
        return replace(
            whole,
            uv_px=uv_px.astype(np.float32),
            point_world=point,
            confidence=whole.confidence[at],
            visible=visible,
            state=np.where(lost, State.LOST.value, np.where(visible, State.TRACKING.value, State.HELD.value)),
            stamp_s=clip.stamp_s,
            lost_p=None if whole.lost_p is None else whole.lost_p[at],
            alarm=None if whole.alarm is None else whole.alarm[at],
            joints=None if whole.joints is None else replace(whole.joints, q=whole.joints.q[at]),
            cam_from_world=clip.cam_from_world,
        )


@dataclass
class _Entity:
    """What is followed in one or several views."""

    query: Query
    """What was asked; its name and label once it is found."""
    number: dict[int, int] = field(default_factory=dict)
    """Of the query in each view's stream that has it."""
    placed_s: dict[int, float] = field(default_factory=dict)
    """When each view was last put to the fused place."""
    found: bool = False
    """Whether a view follows it, or did."""
    fused: Fused | None = None
    """The newest; None before it is found."""


@dataclass(frozen=True)
class _Seen:
    """A view in the newest frame."""

    answer: StreamState
    view: View
    noise: Noise
    covariance: Float[np.ndarray, "K 3 3"]
    """Of the answer's world points."""
    lost_p: Float[np.ndarray, " K"]
    """That each is lost, by this view alone; 1 while an alarm is open."""

    @classmethod
    def of(cls, answer: StreamState, view: View, noise: Noise) -> _Seen:
        point, alarmed = answer.point_world.astype(np.float64), np.array([a is not None for a in answer.alarm], bool)
        lost_p = np.where(np.isfinite(answer.lost_p), answer.lost_p, 1 - answer.confidence)
        covariance = place_covariance(point, answer.visible, view, noise)
        return cls(answer, view, noise, covariance, np.where(alarmed, 1.0, lost_p).astype(np.float64))

    def row(self, number: int | None) -> int | None:
        """The row of a query; None where it is not followed."""
        return self.answer.query.index(number) if number in self.answer.query else None


class ViewsStream:
    """Follows entities in frames of several cameras that come together; :func:`track_views` is a loop over it.

    Its arguments are those of that function; ``answers`` are those of each view to its frames of the newest step.

    Raises:
        InputError: there are too many views, or a query is asked in none of them.
        ConfigError: the tracker is not of this package's filter, or as of :meth:`quest.track.Tracker.stream`.
    """

    def __init__(
        self,
        tracker: Tracker,
        cameras: Sequence[Camera],
        queries: Sequence[Query] | None = None,
        *,
        view: int | Sequence[int] = 0,
        online: bool = False,
        alpha: float | None = DEFAULT_ALPHA,
        alpha_frames: int | None = None,
    ) -> None:
        if not isinstance(tracker, Tracker):
            raise ConfigError(f"several views: expected a quest.Tracker, got {type(tracker).__name__}; load quest-s16")
        count = len(cameras)
        if not 1 <= count <= MOST_VIEWS:
            raise InputError(f"several views: expected 1 to {MOST_VIEWS} of them, got {count}; choose the best ones")
        asked_in = [view] * len(queries or ()) if isinstance(view, int) else list(view)
        if len(asked_in) != len(queries or ()) or any(not 0 <= v < count for v in asked_in):
            raise InputError(f"several views: expected a view of 0 to {count - 1} for each query, got {view}")
        self._noise = tracker.noise
        self._entities: list[_Entity] = []
        asked: list[list[Query]] = [[] for _ in cameras]
        for query, v in zip(queries or (), asked_in, strict=True):
            named = [e for e in self._entities if query.name and e.query.name == query.name and v not in e.number]
            entity = named[0] if named else _Entity(query)
            entity.number[v] = len(asked[v])
            asked[v].append(query)
            self._entities += [] if named else [entity]
        self.streams = [
            tracker.stream(
                camera,
                None if queries is None else own,
                online=online,
                wait=True,
                alpha=None if alpha is None else alpha / count,
                alpha_frames=alpha_frames,
            )
            for camera, own in zip(cameras, asked, strict=True)
        ]
        self.answers: tuple[list[StreamState], ...] = tuple([] for _ in cameras)

    @property
    def queries(self) -> list[Query]:
        """What is followed, or was asked for and not found, in the order of the answers' numbers."""
        return [entity.query for entity in self._entities]

    def number(self, query: int, view: int) -> int | None:
        """The number of a query in a view's stream; None where that view does not follow it."""
        return self._entities[query].number.get(view)

    def step(self, frames: Sequence[Sequence[Frame]]) -> StreamState:
        """Track the next frames.

        Args:
            frames: of each view since the last step, oldest first; none where a view has no new one. The newest of each
                view are fused. The first view must have one; its time and its pixels are the answer's.

        Raises:
            InputError: the first view has no frame, frames have no depth, or as of :meth:`quest.track.Stream.step`.
        """
        if len(frames) != len(self.streams) or not len(frames[0]):
            raise InputError("several views: expected frames of each view, and at least one of the first")
        self.answers = tuple(
            [stream.step(f.rgb, f.depth_m, f.stamp_s, f.cam_from_world) for f in own]
            for stream, own in zip(self.streams, frames, strict=True)
        )
        seen = {
            v: _Seen.of(answers[-1], _view(self.streams[v].camera, frames[v][-1]), self.streams[v].noise)
            for v, answers in enumerate(self.answers)
            if answers
        }
        for v, one in seen.items():
            for entity in self._entities:
                row = one.row(entity.number.get(v))
                if row is not None and not entity.found:
                    self._name(entity, v, row, one.answer)
            self._associate(v, one, seen)
        for entity in self._entities:
            entity.fused = self._fuse(entity, seen) or entity.fused
        state = self._answer(seen)
        for row, k in enumerate(state.query):
            if state.visible[row] and state.state[row] != State.LOST:
                self._spread(self._entities[k], seen, state.stamp_s)
        return state

    def _name(self, entity: _Entity, v: int, row: int, answer: StreamState) -> None:
        """An entity that was found in a view gets its name and label there; no name comes twice."""
        name, others = answer.names[row], {other.query.name for other in self._entities if other.found}
        name = f"{name} (view {v})" if name in others else name
        entity.query, entity.found = replace(entity.query, name=name, label=answer.labels[row]), True

    def _associate(self, v: int, seen: _Seen, all_seen: dict[int, _Seen]) -> None:
        """What a view discovered is what others follow, if it is near enough and of the same label; else it is new."""
        answer = seen.answer
        mine = {entity.number.get(v) for entity in self._entities}
        new = [row for row, number in enumerate(answer.query) if number not in mine]
        if not new:
            return
        others = [(e, f) for e in self._entities if v not in e.number and (f := self._fuse(e, all_seen)) is not None]
        apart = np.full((len(new), len(others)), np.inf)
        anywhere = self._noise.relief_m**2 * np.eye(3)  # on a long handle it is found here or there
        for i, row in enumerate(new):
            for j, (entity, fused) in enumerate(others):
                if entity.query.label == answer.labels[row]:
                    off = answer.point_world[row] - fused.point_world
                    apart[i, j] = off @ np.linalg.solve(seen.covariance[row] + fused.covariance + anywhere, off)
        apart = np.nan_to_num(apart, nan=np.inf, posinf=np.inf)
        pairs = zip(*linear_sum_assignment(np.minimum(apart, 2 * _SAME)), strict=True)
        partner = {int(i): others[int(j)][0] for i, j in pairs if apart[i, j] < _SAME}
        for i, row in enumerate(new):
            entity = partner.get(i)
            if entity is None:
                entity = _Entity(Query.slot())
                self._name(entity, v, row, answer)
                self._entities.append(entity)
            entity.number[v] = answer.query[row]

    def _fuse(self, entity: _Entity, seen: dict[int, _Seen]) -> Fused | None:
        """What the views say of an entity; None where none of them has a frame and follows it."""
        count = len(self.streams)
        rows = {v: row for v, one in seen.items() if (row := one.row(entity.number.get(v))) is not None}
        if not rows:
            return None
        point, covariance, lost_p = np.full((count, 3), np.nan), np.tile(np.eye(3), (count, 1, 1)), np.ones(count)
        for v, row in rows.items():
            point[v], covariance[v] = seen[v].answer.point_world[row], seen[v].covariance[row]
            lost_p[v] = seen[v].lost_p[row]
        return fuse(point, covariance, lost_p, self._noise)

    def _answer(self, seen: dict[int, _Seen]) -> StreamState:
        """The fused answer, in the first view's pixels."""
        found = [(k, e, e.fused) for k, e in enumerate(self._entities) if e.fused is not None]
        first, told = seen[0], [self._told(entity, fused, seen) for _, entity, fused in found]
        point = np.array([fused.point_world for _, _, fused in found]).reshape(-1, 3)
        uv_px = first.view.project(point)[0] if len(found) else np.zeros((0, 2))
        for i, (_, entity, _) in enumerate(found):
            row = first.row(entity.number.get(0))
            if row is not None and not np.isfinite(point[i]).all():
                uv_px[i] = first.answer.uv_px[row]
        lost_p = np.array([fused.lost_p for _, _, fused in found])
        joints = tuple(each.joint for each in told)
        watched = np.array([each.watched for each in told], bool)
        return StreamState(
            names=tuple(entity.query.name for _, entity, _ in found),
            labels=tuple(entity.query.label for _, entity, _ in found),
            uv_px=uv_px.astype(np.float32),
            point_world=point.astype(np.float32),
            confidence=(1 - lost_p).astype(np.float32),
            visible=np.array([each.state is State.TRACKING for each in told], bool),
            state=tuple(each.state for each in told),
            stamp_s=first.answer.stamp_s,
            has_depth=any(one.answer.has_depth for one in seen.values()),
            query=tuple(k for k, _, _ in found),
            joint=joints,
            q=np.array([coordinate(j, p) for j, p in zip(joints, point, strict=True)], np.float32),
            lost_log_odds=logit(lost_p).clip(-_MOST_LOG_ODDS, _MOST_LOG_ODDS).astype(np.float32),
            lost_p=np.where(watched, lost_p, np.nan).astype(np.float32),
            alarm=tuple(each.alarm for each in told),
            cam_from_world=first.view.cam_from_world,
            flags=_flags({v: one.answer.flags for v, one in seen.items()}),
        )

    def _told(self, entity: _Entity, fused: Fused, seen: dict[int, _Seen]) -> _Told:
        """State, alarm and joint of an entity: those of the views that are more probably right than not."""
        rows = {v: row for v, one in seen.items() if (row := one.row(entity.number.get(v))) is not None}
        alarm = next((a for v, row in rows.items() if (a := seen[v].answer.alarm[row]) is not None), None)
        lost = fused.lost_p > 0.5
        right = [(v, row) for v, row in rows.items() if fused.right_p[v] > 0.5]
        visible = any(seen[v].answer.visible[row] for v, row in right)
        joints = [j for v, row in right if (j := seen[v].answer.joint[row]) is not None]
        return _Told(
            state=State.LOST if lost else State.TRACKING if visible else State.HELD,
            alarm=replace(alarm, name=entity.query.name) if lost and alarm is not None else None,
            watched=any(np.isfinite(seen[v].answer.lost_p[row]) for v, row in rows.items()),
            joint=min(joints, key=_uncertainty, default=None),
        )

    def _spread(self, entity: _Entity, seen: dict[int, _Seen], now_s: float) -> None:
        """Views that see the fused place, and do not follow the entity to it, are put there."""
        fused = entity.fused
        if fused is None or 1 - fused.lost_p < _SURE_P or not np.isfinite(fused.point_world).all():
            return
        for v, one in seen.items():
            recent = now_s - entity.placed_s.get(v, -np.inf) < self._noise.correlated_s
            followed = one.row(entity.number.get(v)) is not None
            if recent or (followed and fused.right_p[v] > 0.5) or (not followed and v in entity.number):
                continue
            uv_px, depth_m = one.view.project(fused.point_world[None])
            camera = self.streams[v].camera
            ray = one.view.cam_from_world[2, :3]
            spread_m = np.hypot(depth_error(depth_m, one.noise), np.sqrt(ray @ fused.covariance @ ray))
            off_m = one.view.near_depth_at(uv_px) - depth_m
            if in_image(uv_px, (camera.width, camera.height))[0] and abs(off_m[0]) < spread_m[0]:
                x, y = uv_px[0].tolist()
                stream = self.streams[v]
                if v not in entity.number:
                    entity.number[v] = stream.add(Query.point(stream.frame, x, y, label=entity.query.label))
                stream.place(entity.number[v], x, y)
                entity.placed_s[v] = now_s


@dataclass(frozen=True)
class _Told:
    """What is said of one entity."""

    state: State
    alarm: Alarm | None
    watched: bool
    """Whether a monitor watches it in any view."""
    joint: Joint | None


def track_views(
    tracker: Tracker,
    clips: Sequence[Clip],
    queries: Sequence[Query] | None = None,
    *,
    view: int | Sequence[int] = 0,
    online: bool = False,
    alpha: float | None = DEFAULT_ALPHA,
    alpha_frames: int | None = None,
    report: Callable[[int], object] | None = None,
) -> FusedTracks:
    """Track entities through clips of several cameras that saw them at the same time.

    Frames are paired by their stamps: with each frame of the first clip goes the nearest of each other one, within half
    a frame interval of the first. A view without such a frame adds nothing then.

    Args:
        tracker: what follows the entities in each view.
        clips: with depth, and poses in one world; the first one's times are those of the fused tracks.
        queries: what to follow; None discovers entities in each view, and those that are near each other are one.
        view: in which clip each query is asked, or all of them. Queries of one name in several clips are one; other
            clips follow when they see the entity's place.
        online: as of :meth:`quest.track.Tracker.stream`.
        alpha: probability of any alarm while no view loses an identity; each view has an equal part of it.
        alpha_frames: as of :meth:`quest.track.Tracker.stream`.
        report: called after every frame of the first clip with the number of them that are done.

    Raises:
        InputError: a clip has no depth, its clock or world is not that of the first, or as of
            :meth:`quest.track.Tracker.track`.
        ConfigError: as of :meth:`quest.track.Tracker.stream`.
    """
    stream = ViewsStream(
        tracker,
        [clip.camera for clip in clips],
        queries,
        view=view,
        online=online,
        alpha=alpha,
        alpha_frames=alpha_frames,
    )
    paired = _check(clips)
    for query, v in zip(queries or (), [view] * len(queries or ()) if isinstance(view, int) else view, strict=True):
        if query.frame >= len(clips[v]):
            raise InputError(f"clip {clips[v].name!r}: query at frame {query.frame}, but it has {len(clips[v])} frames")
    states: list[StreamState] = []
    answers: list[list[StreamState]] = [[] for _ in clips]
    for t in range(len(clips[0])):
        until = [max(int(at[t]) + 1, len(own)) for at, own in zip(paired, answers, strict=True)]
        frames = [
            [clip.frame(i) for i in range(len(own), end)] for clip, own, end in zip(clips, answers, until, strict=True)
        ]
        states.append(stream.step(frames))
        for own, new in zip(answers, stream.answers, strict=True):
            own += new
        if report is not None:
            report(t + 1)
    for clip, own, one in zip(clips, answers, stream.streams, strict=True):
        for t in range(len(own), len(clip)):
            frame = clip.frame(t)
            own.append(one.step(frame.rgb, frame.depth_m, frame.stamp_s, frame.cam_from_world))
    return _collected(stream, states, answers, clips, watched=alpha is not None and bool(tracker.calibrations))


def _collected(
    stream: ViewsStream,
    states: list[StreamState],
    answers: list[list[StreamState]],
    clips: Sequence[Clip],
    *,
    watched: bool,
) -> FusedTracks:
    """Answers as tracks, whose queries are in one order."""
    queries, made = stream.queries, []
    for v, own in enumerate(answers):
        numbers = {number: k for k in range(len(queries)) if (number := stream.number(k, v)) is not None}
        own = [replace(state, query=tuple(numbers[n] for n in state.query)) for state in own]
        made.append(replace(collect(own, queries), names=tuple(query.name for query in queries)))
    whole = collect(states, queries)
    notes = dict.fromkeys(note for clip in clips for note in clip.notes)
    whole = replace(whole, frame_flags=(*notes, *whole.frame_flags))
    tracks = [t if watched else replace(t, lost_p=None, alarm=None) for t in (whole, *made)]
    return FusedTracks(tracks[0], tuple(tracks[1:]))


def _check(clips: Sequence[Clip]) -> list[Int[np.ndarray, " T"]]:
    """With which frame of each clip every frame of the first one is paired; -1 without any.

    Raises:
        InputError: a clip has no depth, or its clock or world is not that of the first.
    """
    first, paired = clips[0], []
    step_s = float(np.median(np.diff(first.stamp_s))) if len(first) > 1 else np.inf
    for clip in clips:
        if clip.depth_m is None:
            raise InputError(f"clip {clip.name!r}: expected depth, without which views have no place in common")
        if (
            clip is not first
            and not (clip.cam_from_world - np.eye(4)).any()
            and not (first.cam_from_world - np.eye(4)).any()
        ):
            raise InputError(
                f"clips {first.name!r} and {clip.name!r}: no poses; give cam_from_world of each camera in one world"
            )
        apart_s = np.abs(first.stamp_s[:, None] - clip.stamp_s)
        nearest = apart_s.argmin(axis=1)
        at = np.where(apart_s.min(axis=1) <= step_s / 2, nearest, -1)
        if (at < 0).all():
            spans = [f"{c.stamp_s[0]:.3f} to {c.stamp_s[-1]:.3f} s" for c in (first, clip)]
            raise InputError(
                f"clips {first.name!r} and {clip.name!r}: no frames at the same time ({spans[0]}, {spans[1]}); set "
                "their clocks alike"
            )
        paired.append(at)
    return paired


def _view(camera: Camera, frame: Frame) -> View:
    return View(camera.matrix, frame.cam_from_world, frame.depth_m)


def _uncertainty(joint: Joint) -> tuple[bool, float]:
    """Of which views' joints the least is taken: static is what a view says that has not seen it move."""
    still = joint.kind is JointKind.STATIC
    return still, 0.0 if still else joint.axis_sigma_rad


def _flags(flags: dict[int, tuple[str, ...]]) -> tuple[str, ...]:
    """Those of all views as they are, those of single ones with the view."""
    everywhere = [flag for flag in next(iter(flags.values())) if all(flag in own for own in flags.values())]
    alone = [f"view {v}, {f}" for v, own in flags.items() for f in own if f not in everywhere and f != WITHHELD_FLAG]
    return (*everywhere, *alone)
