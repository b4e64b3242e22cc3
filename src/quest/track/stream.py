"""The step function of tracking: one frame in, one answer per query out, in bounded time and memory."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor

from quest.errors import InputError
from quest.grounding import LinkGroups
from quest.model.decoder import Prediction
from quest.model.network import QuestNetwork
from quest.model.observation import FrameBatch, Observation
from quest.monitor import SIGNALS, Alarm, Budget, Monitor, MonitorState, Signals, Verdict
from quest.track.binding import Binding, BindingState
from quest.track.expectation import joint_rows
from quest.track.following import Answer, Following
from quest.track.intake import Arrival, Intake, IntakeState
from quest.track.lifting import lift_near
from quest.track.marks import beside, marked
from quest.track.matching import match
from quest.track.measuring import measure
from quest.track.placing import LOST_BELOW, Placed, Placer, as_array
from quest.track.settings import TrackerConfig
from quest.track.sharing import SIGMA, share
from quest.track.state import StreamState
from quest.track.world import along_joint, to_world, world_joint
from quest.types import Camera, Query, State

WITHHELD_FLAG = "no P(lost) and no alarms: the monitor is calibrated on frames with depth, and none had any so far"

_LOST_ABOVE = 0.5
_DOUBTED_ABOVE = 0.95
"""Probability of a loss above which a query goes back to where it was right. Below it the answer of the newest frame is
nearer in the mean, wrong as it may be: what is lost has often only drifted, and what is taken back is left behind."""


@dataclass
class Memory:
    """Everything that the next answers depend on, in bounded size; callbacks are left out."""

    intake: IntakeState
    """Of the frames that came."""
    binding: BindingState
    """Of the queries' anchors, and of queries without one."""
    ring: deque[Observation]
    """The newest T frames as observed."""
    monitor: MonitorState | None
    """None where nothing is watched."""
    following: list[Following] = field(default_factory=list)
    """Queries that have found their entity."""
    links: LinkGroups = field(default_factory=lambda: LinkGroups(SIGMA))
    """Which of them share a joint."""
    frame: int = 0
    """Index of the next frame."""
    stamp_s: float = 0.0
    """Time of the newest frame."""
    has_depth: bool = False
    """Whether the newest frame brought any depth."""


class Stream:
    """Tracks queries through frames that come one by one; made by :meth:`quest.track.Tracker.stream`.

    Args:
        network: trained network in evaluation mode.
        config: settings of tracking.
        camera: intrinsics of the frames.
        queries: what to follow; None discovers entities in the first frame.
        device: where the network runs.
        autocast: whether the network computes in bfloat16.
        monitor: watches for lost identities; None for no alarms and no recovery.

    Raises:
        InputError: a point query lies outside the image.
    """

    def __init__(
        self,
        network: QuestNetwork,
        config: TrackerConfig,
        camera: Camera,
        queries: Sequence[Query] | None,
        *,
        device: torch.device,
        autocast: bool,
        monitor: Monitor | None = None,
    ) -> None:
        self._network = network
        self._config = config
        self._device = device
        self._autocast = autocast
        self._monitor = monitor
        self._intake = Intake(network, camera, device=device)
        self._binding = Binding(network, config, self._intake.letterbox, queries)
        self._memory = Memory(
            self._intake.state,
            self._binding.state,
            deque(maxlen=network.config.window),
            None if monitor is None else monitor.state,
        )
        self._callbacks: list[Callable[[Alarm], None]] = []
        self._raised: tuple[Alarm, ...] = ()

    @property
    def memory(self) -> Memory:
        """Everything that the next answers depend on; set it to go on where another stream of this tracker was."""
        return self._memory

    @memory.setter
    def memory(self, memory: Memory) -> None:
        self._memory, self._intake.state, self._binding.state = memory, memory.intake, memory.binding
        if self._monitor is not None and memory.monitor is not None:
            self._monitor.state = memory.monitor

    @property
    def camera(self) -> Camera:
        """Intrinsics of the frames."""
        return self._intake.letterbox.source

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
        return tuple(w.query for w in self._binding.state.waiting)

    @property
    def looking(self) -> bool:
        """Whether a query may still find its entity: labels and slots look for it in the first frames alone."""
        return self._binding.looking(self._memory.frame)

    def add(self, query: Query) -> int:
        """Follow one more entity from the next frame on; returns the query's number.

        Raises:
            InputError: a point query lies outside the image or in a frame that has passed, or its name is taken.
        """
        return self._binding.ask(query, frame=self._memory.frame, following=self._memory.following)

    def retire(self, query: int | str) -> None:
        """Follow a query no longer, by its number or name.

        Raises:
            InputError: no query of that number or name is followed or waits.
        """
        number = self._binding.find(query, self._memory.following)
        rows = [i for i, f in enumerate(self._memory.following) if f.query != number]
        if len(rows) < len(self._memory.following):
            self._binding.keep(rows)
            self._memory.links.forget(number)
            if self._monitor is not None:
                self._monitor.forget(number)
        self._memory.following = [self._memory.following[i] for i in rows]
        self._binding.state.waiting = [w for w in self._binding.state.waiting if w.number != number]

    def rename(self, query: int | str, name: str) -> None:
        """Call a query by another name in all answers from now on.

        Raises:
            InputError: no query of that number or name is followed or waits, or another has the new name.
        """
        number = self._binding.find(query, self._memory.following)
        if name in {other for k, other in self._binding.names(self._memory.following).items() if k != number}:
            raise InputError(f"query {query!r}: another query is called {name!r} already; choose another name")
        for following in self._memory.following:
            if following.query == number:
                following.name = name
                if self._monitor is not None:
                    self._monitor.rename(number, name)
        self._binding.state.waiting = [
            replace(w, query=replace(w.query, name=name)) if w.number == number else w
            for w in self._binding.state.waiting
        ]

    def on_alarm(self, callback: Callable[[Alarm], None]) -> None:
        """Call a function with every alarm at the end of the step that raises it; it may save the stream."""
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
            cam_from_world: pose of the camera; the last one if None, and if there was none, the world is the camera.

        Raises:
            InputError: the frame does not have the camera's size or type, its stamp is not finite, or its pose is not
                rigid; the stream stays as it was.
        """
        intake, memory, self._raised = self._intake, self._memory, ()
        stamp_s = float(stamp_s)
        intake.check(memory.frame, rgb, depth_m, stamp_s, cam_from_world)
        if intake.admit(rgb, stamp_s) is not Arrival.NEW:
            memory.frame += 1
            self._binding.wait()
            return self._state()
        with torch.inference_mode(), torch.autocast(self._device.type, torch.bfloat16, enabled=self._autocast):
            frames, renewed = intake.prepare(rgb, depth_m, cam_from_world)
            if renewed:
                # Coordinates change with the reference, so nothing observed before may be mixed with it.
                memory.ring.clear()
                memory.links = LinkGroups(SIGMA)
                for following in memory.following:
                    following.forget_places(self._config)
            observed = self._network.observe(frames)
            if renewed:
                self._binding.bind_again(observed, frames, memory.following)
            while len(memory.ring) < self._network.config.window - 1:
                memory.ring.append(observed)
            memory.ring.append(observed)
            for found in self._binding.bind(memory.frame, observed, frames, memory.following):
                memory.following.append(found)
                if self._monitor is not None:
                    self._monitor.watch(found.query, found.name)
            memory.stamp_s, memory.has_depth = stamp_s, bool((frames.depth_m > 0).any())
            self._answer(frames)
        self._memory.frame += 1
        for alarm in self._raised:
            for callback in self._callbacks:
                callback(alarm)
        return self._state()

    def _answer(self, frames: FrameBatch) -> None:
        """Place every query in the newest frame, judge it, and keep the answers."""
        memory, following = self._memory, self._memory.following
        if not following or memory.binding.anchor is None:
            return
        window = Observation.stack(list(memory.ring))
        prediction = match(
            self._network,
            self._config,
            memory.binding.anchor,
            window,
            frames,
            following,
            elapsed=memory.intake.elapsed,
        )
        candidate = as_array(lift_near(prediction, frames, self._config.lift_tolerance))
        placer = Placer(
            following, prediction, frames, network=self._network.config, config=self._config,
            picture_px=self._intake.letterbox.picture_px, elapsed=memory.intake.elapsed, now=memory.intake.now,
        )  # fmt: skip
        placed = placer.place(candidate, joint_rows(self._network.joint(prediction.embedding)))
        if self._config.ground:
            share(memory.links, memory.frame, following, placed)
        placed = replace(placed, room=placer.room(placed.judged))
        shown = replace(placed, point=marked(following, placed.point, prediction, frames))
        uv, judged_uv = (self._project(p, frames, prediction) for p in (shown.point, placed.judged))
        uv = beside(following, uv, shown.point, size=self._network.config.encoder.image_size)
        signals = measure(
            self._network, memory.binding.anchor, memory.ring[-1], prediction, placed, judged_uv, following
        )
        for k, query in enumerate(following):
            query.move(placed.point[k], held=bool(placed.held[k]), embedding=prediction.embedding[0, 0, k])
        self._keep(uv, shown, as_array(prediction.right_logit[0, 0].sigmoid()), signals)

    def _project(self, point: np.ndarray, frames: FrameBatch, prediction: Prediction) -> Float[Tensor, "K 2"]:
        """Points in [0, 1]^2 of the input; where they are unknown, what the network sees."""
        at = torch.from_numpy(point).to(frames.depth_m)
        uv = frames.from_reference(at[None, None])[0, 0] / self._network.config.encoder.image_size
        return torch.where(torch.isfinite(uv).all(dim=-1, keepdim=True), uv, prediction.uv[0, 0])

    def _keep(
        self,
        uv: Float[Tensor, "K 2"],
        placed: Placed,
        right: Float[np.ndarray, " K"],
        signals: Signals,
    ) -> None:
        """Judge the answers and keep them; begin or end recoveries; note what alarms were raised."""
        size, following = self._network.config.encoder.image_size, self._memory.following
        uv_px = self._intake.letterbox.to_source(uv.float().cpu().numpy() * size).astype(np.float32)
        inside = np.all((uv_px >= 0) & (uv_px <= (self.camera.width, self.camera.height)), axis=-1)
        assert self._intake.state.reference is not None
        world = to_world(placed.point, self._intake.state.reference)
        world = world if self._memory.has_depth else np.full_like(world, np.nan)
        verdict = None
        # Also of those that are found in this very frame: the answer is where they were held.
        doubted = [query.doubted for query in following]
        if self._monitor is not None and not self._withheld:
            verdict = self._monitor.step(
                [f.query for f in following], signals, frame=self._memory.frame, stamp_s=self._memory.stamp_s
            )
            self._recover(verdict, placed)
        for k, query in enumerate(following):
            visible = bool(placed.seen[k] > 0.5 and inside[k] and not (doubted[k] or query.doubted))
            lost_p = float("nan") if verdict is None else float(verdict.lost_p[k])
            # The network's belief in a single frame only counts where nothing is calibrated.
            lost = lost_p > _LOST_ABOVE or self._alarm(query) is not None or (verdict is None and right[k] < LOST_BELOW)
            query.answer = Answer(
                uv_px=uv_px[k],
                point_world=world[k],
                confidence=float(right[k]),
                visible=visible,
                state=State.LOST if lost else State.TRACKING if visible else State.HELD,
                lost_p=lost_p,
                signals=signals.values[k],
            )
        self._raised = () if verdict is None else tuple(verdict.raised)

    def _recover(self, verdict: Verdict, placed: Placed) -> None:
        """Search for what an alarm says is lost; end the alarm where what is seen matches the anchor again.

        What is held on its joint, unseen, is held on; what is surely seen in a wrong place goes back to where it was
        right.
        """
        assert self._monitor is not None
        for k, query in enumerate(self._memory.following):
            right = bool(verdict.lost_p[k] < self._config.found_below) and not placed.held[k]
            alarm = verdict.open[k]
            if alarm is None:
                if right:
                    query.keep()
                continue
            if alarm in verdict.raised:
                query.good = 0
                if not placed.held[k] and verdict.lost_p[k] > _DOUBTED_ABOVE:
                    query.doubt()
                continue
            known = np.isfinite(placed.judged[k]).all() or not self._memory.has_depth
            query.good = query.good + 1 if right and known else 0
            if query.good >= self._config.found_frames:
                query.trust(placed.judged[k])
                self._monitor.clear(query.query)

    @property
    def _withheld(self) -> bool:
        """Whether P(lost) would say nothing: it is calibrated for streams with depth, and there was none so far."""
        reference = self._intake.state.reference
        return self._monitor is not None and reference is not None and not reference.has_depth

    def _alarm(self, query: Following) -> Alarm | None:
        return None if self._monitor is None else self._monitor.alarm(query.query)

    def _state(self) -> StreamState:
        """The newest answers of all queries."""
        rows = [(f, f.answer) for f in self._memory.following if f.answer is not None]
        answers = [answer for _, answer in rows]
        reference, flags = self._intake.state.reference, self._intake.state.flags
        flags = (*flags, WITHHELD_FLAG) if self._withheld else flags
        joints = tuple(world_joint(self._memory.links.joint(f.query) or f.ground.joint, reference) for f, _ in rows)

        def stacked(name: str, *shape: int) -> np.ndarray:
            return np.array([getattr(a, name) for a in answers], np.float32).reshape(len(answers), *shape)

        return StreamState(
            names=tuple(f.name for f, _ in rows),
            labels=tuple(f.label for f, _ in rows),
            uv_px=stacked("uv_px", 2),
            point_world=stacked("point_world", 3),
            confidence=stacked("confidence"),
            visible=np.array([a.visible for a in answers], bool),
            state=tuple(a.state for a in answers),
            stamp_s=self._memory.stamp_s,
            has_depth=self._memory.has_depth,
            query=tuple(f.query for f, _ in rows),
            joint=joints,
            q=np.array(
                [along_joint(f, joint, reference) for (f, _), joint in zip(rows, joints, strict=True)], np.float32
            ),
            lost_p=stacked("lost_p"),
            alarm=tuple(self._alarm(f) for f, _ in rows),
            signals=Signals(stacked("signals", len(SIGNALS))),
            flags=flags,
        )
