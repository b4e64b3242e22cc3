"""The tracker a user holds."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from quest.data.recording import read_recording
from quest.errors import ConfigError, InputError, WeightsError
from quest.grounding import Joint, JointKind
from quest.model.discovery import Peaks, find_peaks
from quest.model.network import QuestNetwork
from quest.model.precision import fast_bfloat16
from quest.model.weights import load_network
from quest.monitor import Budget, Calibration, Monitor
from quest.track.intake import NO_DEPTH_FLAG, Intake
from quest.track.saving import load as restored
from quest.track.saving import save
from quest.track.settings import REVISION, TrackerConfig
from quest.track.state import StreamState
from quest.track.stream import WITHHELD_FLAG, Memory, Stream
from quest.types import Camera, Clip, Frame, Joints, Query, State, Tracks

DEFAULT_WEIGHTS = "quest-s16"
DEFAULT_ALPHA = 0.05
PARTLY_NO_DEPTH_FLAG = "depth missing in some frames: world points there are NaN"
PARTLY_WITHHELD_FLAG = "no P(lost) and no alarms in the frames until depth began: the monitor is calibrated for depth"
NOTHING_FOUND_FLAG = "discovery found no entity in the first frame; give a point or a label"


@dataclass(frozen=True)
class Maker:
    """What a saved stream must be restored with."""

    weights_hash: str | None
    settings: TrackerConfig
    revision: int
    calibration_hash: str
    camera: Camera


@dataclass(frozen=True)
class SavedStream:
    """A stream outside of a process; without a budget nothing is watched."""

    maker: Maker
    budget: Budget | None
    memory: Memory


class Tracker:
    """Follows entities through clips and streams; make one with :func:`load`.

    Args:
        network: trained network.
        config: settings of tracking.
        device: where the network runs.
        weights_hash: SHA-256 of the file that the network came from, for result files and saved streams.
        calibration: of the monitor; None for no alarms.
    """

    name = "quest"

    def __init__(
        self,
        network: QuestNetwork,
        config: TrackerConfig,
        *,
        device: torch.device,
        weights_hash: str | None = None,
        calibration: Calibration | None = None,
    ) -> None:
        self.network = network.to(device).eval()
        self.config = config
        self.device = device
        self.weights_hash = weights_hash
        self.calibration = calibration
        self._autocast = fast_bfloat16(device)

    def __repr__(self) -> str:
        weights = "unnamed weights" if self.weights_hash is None else f"weights {self.weights_hash[:8]}"
        monitor = "no monitor" if self.calibration is None else "monitored"
        return f"Tracker({self.name!r}, {weights}, on {self.device}, {monitor})"

    def with_config(self, config: TrackerConfig, *, name: str) -> Tracker:
        """A tracker that shares this one's network under other settings.

        Args:
            config: its settings.
            name: what tables call it.
        """
        other = Tracker(
            self.network, config, device=self.device, weights_hash=self.weights_hash, calibration=self.calibration
        )
        other.name, other._autocast = name, self._autocast
        return other

    def stream(
        self,
        camera: Camera,
        queries: Sequence[Query] | None = None,
        *,
        alpha: float | None = DEFAULT_ALPHA,
        alpha_frames: int | None = None,
    ) -> Stream:
        """Start tracking frames that come one by one.

        Args:
            camera: intrinsics of the frames.
            queries: what to follow; None discovers entities in the first frame.
            alpha: probability of any alarm in a stream in which no identity is lost (``docs/monitor.md`` says what is
                promised); None for no alarms and no recovery. Weights without a calibration raise no alarms.
            alpha_frames: alpha is for every so many frames instead, such as 300 for ten seconds at 30 frames a second:
                alarms then come as readily late in a stream as early.

        Raises:
            InputError: a point query lies outside the image.
            ConfigError: alpha is no probability, or there are no frames.
        """
        monitor = None
        if alpha is not None:
            Budget(alpha, alpha_frames)  # refused in words whether or not it is of use
            if self.calibration is not None:
                monitor = Monitor(self.calibration, alpha=alpha, alpha_frames=alpha_frames)
        return Stream(
            self.network, self.config, camera, queries, device=self.device, autocast=self._autocast, monitor=monitor
        )

    def candidates(self, camera: Camera, frame: Frame) -> Peaks:
        """What discovery would choose from in a frame, whatever its score.

        Args:
            camera: intrinsics of the frame.
            frame: the frame.

        Raises:
            InputError: the frame does not have the camera's size or type, or its pose or stamp is not finite.
        """
        intake = Intake(self.network, camera, device=self.device)
        intake.check(0, frame.rgb, frame.depth_m, frame.stamp_s, frame.cam_from_world)
        with torch.inference_mode(), torch.autocast(self.device.type, torch.bfloat16, enabled=self._autocast):
            frames, _ = intake.prepare(frame.rgb, frame.depth_m, frame.cam_from_world)
            observed = self.network.observe(frames)
            return find_peaks(self.network, frames, observed, radius_cells=self.config.slot_radius_cells)

    def save(self, stream: Stream) -> bytes:
        """A stream of this tracker as bytes; callbacks are left out."""
        alpha = None if stream.budget is None else stream.budget.alpha
        return save(SavedStream(self._maker(stream.camera, alpha), stream.budget, stream.memory))

    def restore(self, data: bytes) -> Stream:
        """Go on with a stream that :meth:`save` gave, as if nothing had happened in between.

        Raises:
            InputError: the bytes are corrupt, or belong to other weights or settings.
        """
        saved = restored(data, SavedStream, device=self.device)
        alpha, frames = (None, None) if saved.budget is None else (saved.budget.alpha, saved.budget.frames)
        if saved.maker != self._maker(saved.maker.camera, alpha):
            raise InputError(
                "saved stream: it belongs to other weights, settings or calibration, or to another revision of the "
                "tracker; load those that it was made with"
            )
        stream = self.stream(saved.maker.camera, (), alpha=alpha, alpha_frames=frames)
        stream.memory = saved.memory
        return stream

    def track(
        self,
        clip: Clip | str | Path | np.ndarray | torch.Tensor,
        queries: Sequence[Query] | None = None,
        *,
        alpha: float | None = DEFAULT_ALPHA,
        alpha_frames: int | None = None,
        report: Callable[[int], object] | None = None,
    ) -> Tracks:
        """Track a whole clip: the stream's step in a loop.

        Args:
            clip: the frames; or what :func:`quest.read` reads, by its path; or colours alone, [T, H, W, 3], as an array
                or tensor that :meth:`quest.Clip.from_arrays` takes.
            queries: what to follow; None discovers entities in the first frame.
            alpha: as in :meth:`stream`.
            alpha_frames: as in :meth:`stream`; ``len(clip)`` shares alpha among all parts of the clip alike.
            report: called after every frame with the number of frames that are done.

        Raises:
            InputError: a point query lies outside the clip, or two queries have one name; or the frames are not as
                expected.
            TakeError: a path names a take that cannot be read.
            ConfigError: alpha is no probability, or there are no frames.
        """
        if isinstance(clip, str | Path):
            clip = read_recording(clip)
        elif not isinstance(clip, Clip):
            clip = Clip.from_arrays(clip)
        stream = self.stream(clip.camera, queries, alpha=alpha, alpha_frames=alpha_frames)
        for query in queries or ():
            if query.frame >= len(clip):
                raise InputError(
                    f"clip {clip.name!r}: query at frame {query.frame}, but the clip has {len(clip)} frames"
                )
        states = []
        for t in range(len(clip)):
            frame = clip.frame(t)
            states.append(stream.step(frame.rgb, frame.depth_m, frame.stamp_s, frame.cam_from_world))
            if report is not None:
                report(t + 1)
        tracks = collect(states, queries)
        tracks = replace(tracks, frame_flags=(*clip.notes, *tracks.frame_flags))
        return tracks if stream.budget is not None else replace(tracks, lost_p=None, alarm=None)

    def _maker(self, camera: Camera, alpha: float | None) -> Maker:
        watched = "" if alpha is None or self.calibration is None else self.calibration.to_json()
        monitor = hashlib.sha256(watched.encode()).hexdigest()
        return Maker(self.weights_hash, self.config, REVISION, monitor, camera)


def load(name: str | Path = DEFAULT_WEIGHTS, *, device: str = "auto", monitor: bool = True) -> Tracker:
    """A tracker from shipped weights, from a file, or from the Hugging Face hub.

    Args:
        name: name of shipped weights; path of a safetensors file or of a folder of a run; or ``owner/name`` of a model
            repository on the hub, optionally ``owner/name@revision``. What was fetched once works without a network.
        device: ``cpu``, ``cuda``, ``cuda:1``, ``mps``, or ``auto``: CUDA if there is any, else the CPU.
        monitor: whether to read the monitor's calibration, without which there are no alarms. One that is about to be
            made anew may be of signals that are no more.

    Raises:
        WeightsError: no such weights here or on the hub, the hub cannot be reached and the cache has no copy, or the
            file is torn, foreign, or of another shape.
        ConfigError: no such device.
    """
    loaded = load_network(name)
    calibration = Calibration.from_json(loaded.monitor) if loaded.monitor and monitor else None
    if calibration is not None and calibration.revision != REVISION:
        raise WeightsError(
            f"weights {name}: their monitor knows the signals of another tracker (revision {calibration.revision}, "
            f"this is {REVISION}) and would promise nothing; run `quest weights calibrate`, or load without it"
        )
    return Tracker(
        loaded.network,
        TrackerConfig.from_json(loaded.settings),
        device=pick_device(device),
        weights_hash=loaded.sha256,
        calibration=calibration,
    )


def pick_device(name: str) -> torch.device:
    """The device of a name.

    Raises:
        ConfigError: torch does not know or cannot reach it.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        raise ConfigError(f"device {name!r} cannot be used ({error}); try cpu") from error
    return device


def collect(states: Sequence[StreamState], queries: Sequence[Query] | None) -> Tracks:
    """Join the answers of successive frames; before a query binds its answers are NaN.

    Args:
        states: answers of all frames, in order.
        queries: what was asked, which gives the order of the tracks; None where the stream discovered entities. Those
            that never found their entity are lost in every frame, and flagged.
    """
    last = states[-1]
    t, k = len(states), len(last.names) if queries is None else len(queries)
    names, labels = [q.name or q.label or q.kind for q in queries or ()], [q.label for q in queries or ()]
    names, labels = names or [""] * k, labels or [None] * k
    for i, name, label in zip(last.query, last.names, last.labels, strict=True):
        names[i], labels[i] = name, label
    uv = np.full((t, k, 2), np.nan, np.float32)
    point = np.full((t, k, 3), np.nan, np.float32)
    confidence, lost_p = np.zeros((t, k), np.float32), np.full((t, k), np.nan, np.float32)
    visible, alarm = np.zeros((t, k), bool), np.zeros((t, k), bool)
    state = np.full((t, k), State.LOST.value, dtype="<U8")
    for i, s in enumerate(states):
        rows = list(s.query)
        uv[i, rows], point[i, rows] = s.uv_px, s.point_world
        confidence[i, rows], visible[i, rows] = s.confidence, s.visible
        lost_p[i, rows], alarm[i, rows] = s.lost_p, [a is not None for a in s.alarm]
        state[i, rows] = [value.value for value in s.state]
    with_depth = [s.has_depth for s in states]
    flags = [] if all(with_depth) else [PARTLY_NO_DEPTH_FLAG if any(with_depth) else NO_DEPTH_FLAG]
    withheld = [WITHHELD_FLAG in s.flags for s in states]
    flags += [WITHHELD_FLAG] if all(withheld) else [PARTLY_WITHHELD_FLAG] if any(withheld) else []
    lost = [names[i] for i in range(k) if i not in last.query]
    flags += [f"query {name!r} found no entity: lost in every frame" for name in lost]
    flags += [NOTHING_FOUND_FLAG] if queries is None and not k else []
    told = Counter(
        flag.partition(":")[0] for s in states for flag in s.flags if flag not in (NO_DEPTH_FLAG, WITHHELD_FLAG)
    )
    flags += [f"{what}: {count} of {t} frames" for what, count in told.items()]
    stamps = np.array([s.stamp_s for s in states])
    return Tracks(
        names=tuple(names),
        labels=tuple(labels),
        uv_px=uv,
        point_world=point,
        confidence=confidence,
        visible=visible,
        state=state,
        stamp_s=stamps,
        frame_flags=tuple(flags),
        lost_p=lost_p,
        alarm=alarm,
        joints=_joints(states, k),
    )


def _joints(states: Sequence[StreamState], queries: int) -> Joints:
    """The joints of the last frame as arrays in the order of the queries, and where on them each frame was."""
    last, found = states[-1], Joints.unknown(len(states), queries)
    kind = list(found.kind)
    for k, joint in zip(last.query, last.joint, strict=True):
        if joint is None:
            continue
        kind[k], found.origin[k], found.covariance[k] = joint.kind.value, joint.origin, joint.line_covariance
        if joint.kind is not JointKind.STATIC:
            found.axis[k], found.q_min_seen[k], found.q_max_seen[k] = joint.axis, joint.lower, joint.upper
            found.q[:, k] = [_coordinate(joint, state, k) for state in states]
    return replace(found, kind=tuple(kind))


def _coordinate(joint: Joint, state: StreamState, query: int) -> float:
    """Where a query was in a frame, on a joint that became known later: from where it was on the joint of then."""
    row = state.query.index(query) if query in state.query else None
    then = None if row is None else state.joint[row]
    if row is None or then is None or not np.isfinite(state.point_world[row]).all():
        return float("nan")
    place = then.rest[None] if then.kind is JointKind.STATIC else then.at(state.q[row : row + 1].astype(np.float64))
    return float(joint.locate(place)[0])
