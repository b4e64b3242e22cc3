"""The step function of tracking: one frame in, one answer per query out, in bounded time and memory."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from jaxtyping import Float, Float32, UInt8
from scipy.special import logit

from quest.errors import InputError
from quest.filter import step as filtering
from quest.filter.joints import Joint, JointKind
from quest.filter.noise import Noise
from quest.filter.picture import GreyPicture
from quest.filter.step import Answer, FilterState
from quest.filter.view import View, in_image, move
from quest.model.doubt import Doubt
from quest.model.finder import FinderNetwork
from quest.model.found import Found, find
from quest.model.xfeat import XFeat
from quest.monitor import Alarm, Budget, Calibration, Inputs, Monitor, MonitorState, probability
from quest.track.describing import Describer
from quest.track.finding import FORGOTTEN, Finding, Looker
from quest.track.preprocess import Prepared, Preprocessor, PreprocessorState
from quest.track.queries import QueriesState, StreamQueries
from quest.track.settings import TrackerConfig
from quest.track.state import StreamState
from quest.types import LABELS, Camera, Query, State

_LOG = logging.getLogger(__name__)

WITHHELD_FLAG = "no P(lost) and no alarms: the monitor is not calibrated for what the frames bring so far"
POSES_BEGIN_FLAG = "poses begin: world points were in the first camera's axes before"


@dataclass
class Memory:
    """Everything that the next answers depend on, in bounded size; callbacks are left out."""

    preprocessor: PreprocessorState
    """Of the frames that came."""
    queries: QueriesState
    """What is followed, and what waits."""
    monitor: MonitorState | None
    """None where nothing is watched."""
    filter: FilterState | None = None
    """None before the first frame."""
    world_from_filter: Float[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    """From the world of the filter, the first camera's axes, to that of the poses."""
    frame: int = 0
    """Index of the next frame."""
    inputs: Inputs | None = None
    """What the monitor judges by."""
    answer: StreamState | None = None
    """What was answered in the newest frame."""
    finding: Finding | None = None
    """What later looks of the finder told; None where finding does not go on."""


class Stream:
    """Tracks queries through frames that come one by one; made by :meth:`quest.track.Tracker.stream`."""

    def __init__(
        self,
        network: FinderNetwork,
        features: XFeat,
        noise: Noise,
        config: TrackerConfig,
        camera: Camera,
        queries: Sequence[Query] | None,
        *,
        calibrations: Mapping[Inputs, Calibration],
        doubt: Doubt,
        budget: Budget | None,
        finding: Finding | None = None,
    ) -> None:
        self._describer = Describer(features)
        self._base_noise = noise
        self._config = config
        self._calibrations = calibrations
        self._doubt = doubt
        self._preprocessor = Preprocessor(camera, config.follow_px)
        self._network = network
        self._queries = StreamQueries(config, camera, queries if finding is None else ())
        self._monitor = None
        if budget is not None and calibrations:
            first = next(iter(calibrations.values()))
            self._monitor = Monitor(first, alpha=budget.alpha, alpha_frames=budget.frames)
        state = None if self._monitor is None else self._monitor.state
        self._memory = Memory(self._preprocessor.state, self._queries.state, state, finding=finding)
        self._looker = Looker(behind=finding is not None and finding.behind)
        self._callbacks: list[Callable[[Alarm], None]] = []

    @property
    def noise(self) -> Noise:
        """Parameters of the filter; how noisy depth is was measured on the stream's own."""
        return replace(self._base_noise, depth_grows=self._preprocessor.state.depth_grows)

    @property
    def memory(self) -> Memory:
        """Everything that the next answers depend on; set it to go on where another stream of this tracker was."""
        return self._memory

    @memory.setter
    def memory(self, memory: Memory) -> None:
        self._memory, self._preprocessor.state, self._queries.state = memory, memory.preprocessor, memory.queries
        self._looker = Looker(behind=memory.finding is not None and memory.finding.behind)
        if self._monitor is not None and memory.monitor is not None:
            if memory.inputs is not None and memory.inputs in self._calibrations:
                self._monitor.calibration = self._calibrations[memory.inputs]
            self._monitor.state = memory.monitor

    @property
    def camera(self) -> Camera:
        """Intrinsics of the frames."""
        return self._preprocessor.camera

    @property
    def budget(self) -> Budget | None:
        """How often alarms may be false; None where nothing is watched."""
        return None if self._monitor is None else self._monitor.budget

    @property
    def frame(self) -> int:
        """Index of the next frame; point queries that are added now begin there or later."""
        return self._memory.frame

    @property
    def unbound(self) -> tuple[Query, ...]:
        """Queries that have not found their entity, and point queries whose frame has not come."""
        return tuple(w.query for w in self._queries.state.waiting)

    @property
    def looking(self) -> bool:
        """Whether something may still be found: labels and slots look for a quarter of a second, ``online`` always."""
        return self._memory.finding is not None or self._queries.looking(self._preprocessor.state.now_s)

    def add(self, query: Query) -> int:
        """Follow one more entity from the next frame on; returns the query's number.

        Raises:
            InputError: a point query lies outside the image or in a frame that has passed, or its name is taken.
        """
        return self._queries.ask(query, frame=self._memory.frame)

    def retire(self, query: int | str) -> None:
        """Follow a query no longer, by its number or name.

        Raises:
            InputError: no query of that number or name is followed or waits.
        """
        number = self._queries.find(query)
        followed = {f.number for f in self._queries.state.following}
        rows = self._queries.retire(number)
        if number in followed:
            assert self._memory.filter is not None
            self._memory.filter = filtering.keep(self._memory.filter, rows)
            if self._monitor is not None:
                self._monitor.forget(number)

    def rename(self, query: int | str, name: str) -> None:
        """Call a query by another name in all answers from now on.

        Raises:
            InputError: no query of that number or name is followed or waits, or another has the new name.
        """
        number = self._queries.find(query)
        self._queries.rename(number, name)
        if self._monitor is not None and any(f.number == number for f in self._queries.state.following):
            self._monitor.rename(number, name)

    def place(self, query: int | str, x: float | int, y: float | int) -> None:
        """Say where the entity of a query is in the newest frame: it is followed from there, whatever was believed.

        What it looks like there is what it is known by from now on. An open alarm ends, as the monitor's promise counts
        it (:meth:`quest.monitor.Monitor.clear`). The other queries are not touched.

        Args:
            query: number or name.
            x: pixel of the newest frame that showed anything.
            y: likewise.

        Raises:
            InputError: no such query, the pixel lies outside the image, or no frame has come.
        """
        number, state, size = self._queries.find(query), self._memory.filter, (self.camera.width, self.camera.height)
        at_px = np.array([[x, y]], np.float64)
        if state is None:
            raise InputError(f"query {query!r}: expected a frame first, which the pixel is of, got none")
        if not in_image(at_px, size).all():
            raise InputError(f"query {query!r}: expected a pixel within {size[0]} x {size[1]}, got ({x:.1f}, {y:.1f})")
        row, count = self._queries.begin(number), len(state.queries)
        others = [i for i in range(count) if i != row]
        order = [*range(row), len(others), *range(row, len(others))]
        self._memory.filter = filtering.keep(filtering.ask(filtering.keep(state, others), at_px, self.noise), order)
        self._watch_new(corrected=number)

    def confirm(self, query: int | str) -> None:
        """Say that the newest answer to a query is right; an open alarm ends, as in :meth:`place`.

        Where it is seen, what it looks like is taken anew; where it is occluded, it is believed to be there.

        Raises:
            InputError: no such query, or it has not found its entity.
        """
        number, memory = self._queries.find(query), self._memory
        row = self._queries.row(number)
        if row is None or memory.filter is None:
            raise InputError(f"query {query!r}: expected one that has found its entity, got one that waits")
        answer = filtering.read_off(memory.filter, self.noise)
        if answer.visible[row]:
            self.place(number, *answer.uv_px[row].tolist())
        else:
            memory.filter = filtering.confirm(memory.filter, row)
            self._watch_new(corrected=number)

    def _watch_new(self, *, corrected: int | None = None) -> None:
        """The monitor watches what is followed from now on, and ends the alarm of what somebody has corrected."""
        if self._monitor is None:
            return
        for following in self._queries.state.following:
            if following.number not in self._monitor.state.name:
                self._monitor.watch(following.number, following.name)
        if corrected is not None:
            self._monitor.clear(corrected)

    def on_alarm(self, callback: Callable[[Alarm], None]) -> None:
        """Call a function with every alarm at the end of the step that raises it; it may save the stream.

        What it raises is logged, and the step goes on.
        """
        self._callbacks.append(callback)

    def step(
        self,
        rgb: UInt8[np.ndarray, "H W 3"],
        depth_m: Float32[np.ndarray, "H W"] | None,
        stamp_s: float,
        cam_from_world: Float[np.ndarray, "4 4"] | None = None,
    ) -> StreamState:
        """Track the next frame.

        A frame that is older than the one before, or the same again, changes nothing: the answer before is repeated,
        flagged. Longer gaps between stamps let things move farther.

        Args:
            rgb: colours.
            depth_m: metres along +z; 0 or NaN where missing, None without depth.
            stamp_s: time in seconds.
            cam_from_world: pose of the camera. It is estimated from picture and depth if None, and as long as the poses
                that are given never change; the world is then the first camera.

        Raises:
            InputError: the frame does not have the camera's size or type, its stamp is not finite, or its pose is not
                rigid; the stream stays as it was.
            Exception: whatever the finder raises, in a look in the background too; the next frame can be tracked.
        """
        preprocessor, memory = self._preprocessor, self._memory
        stamp_s = preprocessor.check(memory.frame, rgb, depth_m, stamp_s, cam_from_world)
        accepted = preprocessor.accept(rgb, stamp_s)
        memory.frame += 1
        if not accepted:
            return self._repeated()
        grey = preprocessor.picture(rgb)
        describe = self._describer.begin(grey.grey)
        frame = preprocessor.prepare(rgb, depth_m, cam_from_world)
        state = self._filter(frame, grey, describe)
        at_px = filtering.pixels(state)
        new_px = self._queries.bind(memory.frame - 1, preprocessor.state.now_s, at_px, partial(self._look, rgb))
        memory.filter = filtering.ask(state, new_px, self.noise) if len(new_px) else state
        if memory.finding is not None:
            memory.filter = self._find(memory.finding, memory.filter, rgb)
        self._watch_new()
        memory.answer, raised = self._answer(memory.filter, stamp_s, has_depth=frame.depth_m is not None)
        for alarm in raised:
            for callback in self._callbacks:
                try:
                    callback(alarm)
                except Exception:  # of the user's own: neither the answer nor another callback is to be lost by it
                    _LOG.exception("a callback of on_alarm failed")
        return memory.answer

    def _filter(
        self, frame: Prepared, grey: GreyPicture, describe: Callable[[], Float32[np.ndarray, "D h w"]]
    ) -> FilterState:
        """The filter's state after a frame."""
        memory, now_s = self._memory, self._preprocessor.state.now_s
        if frame.blind and memory.filter is not None:
            return memory.filter
        if memory.filter is None:
            # In the first camera's axes, so that answers do not depend on where the world has its origin.
            view = View(self._preprocessor.matrix, np.eye(4), frame.depth_m)
            state = filtering.begin(grey.described(describe()), view, now_s, self.noise)
        else:
            given = None if frame.cam_from_world is None else frame.cam_from_world @ memory.world_from_filter
            state = filtering.step(memory.filter, grey, describe, frame.depth_m, now_s, given, self.noise)
        if frame.first_pose is not None:
            memory.world_from_filter = np.linalg.inv(frame.first_pose) @ state.view.cam_from_world
            self._preprocessor.state.flags += () if memory.filter is None else (POSES_BEGIN_FLAG,)
        return state

    def _look(self, rgb: UInt8[np.ndarray, "H W 3"]) -> Found:
        return find(self._network, rgb, size_px=self._config.size_px, odds=self._config)

    def _find(self, finding: Finding, state: FilterState, rgb: UInt8[np.ndarray, "H W 3"]) -> FilterState:
        """Begin a look if it is time, and take in the last one if it is there: what is likely enough is followed."""
        config, queries = self._config, self._queries
        finding.warp = state.warp @ finding.warp
        if self._looker.idle and finding.due(state.stamp_s):
            finding.begin(state)
            self._looker.begin(partial(self._look, rgb.copy()))
        found, look = self._looker.take(), finding.frame
        if found is None or look is None:
            return state
        finding.looked_s = look.stamp_s
        found = found.select(np.isin(found.labels, LABELS))
        followed = queries.near(found, filtering.pixels(look)).any(axis=1)
        found = found.select(np.flatnonzero(~followed))
        told = finding.candidates.after(found, queries.near(found, finding.candidates.uv_px))
        alone = filtering.moves_alone(look, found.uv_px)
        least = logit(np.where(alone, min(config.threshold, config.prompt_threshold), config.threshold))
        sure = np.flatnonzero(told.log_odds[: len(found)] > least)
        sure = sure[~filtering.returns(look, found.uv_px[sure], self.noise)]
        now_px = filtering.carry(look, state, finding.warp, found.uv_px[sure])
        moved = np.tile(now_px - found.uv_px[sure], 2)
        now = replace(found.select(sure), uv_px=now_px, box_px=found.box_px[sure] + moved)
        there = np.flatnonzero(in_image(now_px, (self.camera.width, self.camera.height)))
        begun = there[queries.discover(now.select(there), filtering.pixels(state))]
        left = np.setdiff1d(np.flatnonzero(told.log_odds > FORGOTTEN), sure[begun])
        finding.candidates = told.only(left[np.argsort(-told.log_odds[left], kind="stable")][: config.most])
        return filtering.ask(state, now_px[begun], self.noise) if len(begun) else state

    def _answer(self, state: FilterState, stamp_s: float, *, has_depth: bool) -> tuple[StreamState, tuple[Alarm, ...]]:
        """What is said of the newest frame, and the alarms that are raised in it."""
        memory, following, told = self._memory, self._queries.state.following, self._preprocessor.state
        answer, numbers = self._doubted(filtering.read_off(state, self.noise)), [f.number for f in following]
        lost_p, alarms, raised = self._watch(numbers, answer, state, stamp_s)
        doubt, blind_s = probability(answer.lost_log_odds), told.now_s - state.stamp_s
        if blind_s > 0:  # while nothing is seen, everything may come to move
            stays = np.exp(-blind_s / self.noise.hidden_s)
            lost_p, doubt = (1 - (1 - p) * stays for p in (lost_p, doubt))
        lost = [
            (p if np.isfinite(p) else d) > 0.5 or alarm is not None
            for p, d, alarm in zip(lost_p, doubt, alarms, strict=True)
        ]
        visible = answer.visible & (blind_s <= 0) & ~np.array([alarm is not None for alarm in alarms], bool)
        joints = tuple(None if j is None else j.moved(memory.world_from_filter) for j in answer.joint)
        point = move(memory.world_from_filter, answer.point_world)
        tells = told.posed or told.has_depth  # how the camera moves
        answered = StreamState(
            names=tuple(f.name for f in following),
            labels=tuple(f.label for f in following),
            uv_px=answer.uv_px.astype(np.float32),
            point_world=point.astype(np.float32),
            confidence=(1 - doubt).astype(np.float32),
            visible=visible,
            state=tuple(
                State.LOST if gone else State.TRACKING if seen else State.HELD
                for gone, seen in zip(lost, visible, strict=True)
            ),
            stamp_s=stamp_s,
            has_depth=has_depth,
            query=tuple(numbers),
            joint=joints,
            q=np.array([coordinate(j, p) for j, p in zip(joints, point, strict=True)], np.float32),
            lost_log_odds=answer.lost_log_odds.astype(np.float32),
            lost_p=lost_p.astype(np.float32),
            alarm=alarms,
            cam_from_world=state.view.cam_from_world @ np.linalg.inv(memory.world_from_filter) if tells else None,
            flags=told.flags,
        )
        return answered, raised

    def _doubted(self, answer: Answer) -> Answer:
        """With learned log odds of a loss, where depth tells more than colours alone."""
        if not (self._preprocessor.state.has_depth and len(answer.readings)):
            return answer
        told = self._doubt.log_odds(answer.readings)
        return replace(answer, lost_log_odds=np.where(np.isnan(told), answer.lost_log_odds, told))

    def _watch(
        self, numbers: list[int], answer: Answer, state: FilterState, stamp_s: float
    ) -> tuple[np.ndarray, tuple[Alarm | None, ...], tuple[Alarm, ...]]:
        """Calibrated P(lost), open alarms, and those that are raised now."""
        memory, monitor = self._memory, self._monitor
        nothing = np.full(len(numbers), np.nan), (None,) * len(numbers), ()
        if monitor is None:
            return nothing
        inputs: Inputs = "depth" if self._preprocessor.state.has_depth else "colours"
        if inputs not in self._calibrations:
            self._preprocessor.state.flags += (WITHHELD_FLAG,)
            return nothing
        if inputs != memory.inputs:
            monitor.switch(self._calibrations[inputs])
            memory.inputs = inputs
        verdict = monitor.step(
            numbers,
            answer.lost_log_odds,
            lambda row: reason(state, row, answer.uv_px[row]),
            frame=memory.frame - 1,
            stamp_s=stamp_s,
        )
        return verdict.lost_p, verdict.open, verdict.raised

    def _repeated(self) -> StreamState:
        """The answer before, of the queries that are still followed, flagged."""
        before, flags = self._memory.answer, self._preprocessor.state.flags
        assert before is not None, "the first frame is always new"
        following = [f for f in self._queries.state.following if f.number in before.query]
        rows = [before.query.index(f.number) for f in following]
        return replace(before.only(rows), names=tuple(f.name for f in following), flags=flags)


def coordinate(joint: Joint | None, point: Float[np.ndarray, "3"]) -> float:
    """Where on its joint a point is, radians or metres; NaN without a joint that moves."""
    if joint is None or joint.kind is JointKind.STATIC:
        return float("nan")
    return float(joint.locate(point[None])[0])


def reason(state: FilterState, row: int, uv_px: Float[np.ndarray, "2"]) -> str:
    """Why the query of a row, which is answered by a pixel, is probably lost: words for who holds the camera."""
    queries = state.queries
    seen, unseen_s = queries.seen_log_odds[row], queries.unseen_s[row]
    if seen > 0:
        why = "looks little like its anchor"
    elif unseen_s > 0:
        why = f"not seen for {unseen_s:.1f} s where it should be"
    else:
        why = "behind something or out of view"
    if queries.rival_log_odds[row] < seen:
        return why
    apart_px = np.linalg.norm(state.picture.to_camera(queries.rival_px[row : row + 1])[0] - uv_px)
    return f"{why}; looks more like what is {apart_px:.0f} px away"
