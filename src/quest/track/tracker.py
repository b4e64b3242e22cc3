"""The tracker a user holds."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, UInt8

from quest.data.recording import read_recording
from quest.errors import ConfigError, InputError, WeightsError
from quest.filter.joints import Joint, JointKind
from quest.filter.noise import Noise
from quest.filter.queries import READINGS
from quest.model.doubt import read_doubt
from quest.model.finder import FinderNetwork
from quest.model.found import Found, find
from quest.model.weights import load_network
from quest.model.xfeat import XFeat
from quest.monitor import Budget, Calibration, Inputs, read_calibrations
from quest.track.engine import BY_TORCH, networks
from quest.track.finding import Finding
from quest.track.preprocess import NO_DEPTH_FLAG
from quest.track.saving import load as restored
from quest.track.saving import save
from quest.track.settings import REVISION, TrackerConfig
from quest.track.state import StreamState
from quest.track.stream import WITHHELD_FLAG, Memory, Stream
from quest.types import Camera, Clip, Joints, Query, State, Tracks

DEFAULT_WEIGHTS = "quest-s16"
DEFAULT_ALPHA = 0.05
PARTLY_NO_DEPTH_FLAG = "depth missing in some frames: world points there are where the bodies carry them, NaN at first"
PARTLY_WITHHELD_FLAG = "no P(lost) and no alarms in the frames until depth began: the monitor is calibrated for depth"
NOTHING_FOUND_FLAG = "discovery found no entity; give a point or a label"


@dataclass(frozen=True)
class Maker:
    """What a saved stream must be restored with."""

    weights_hash: str | None
    settings: TrackerConfig
    noise: Noise
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
        network: finds entities; what it finds, and points that are given, the filter follows.
        config: settings of discovery.
        device: where the networks run.
        weights_hash: SHA-256 of the file that the network came from, for result files and saved streams.
        calibrations: of the monitor, by what frames bring; without any there are no alarms.
        noise: parameters of the filter.
        features: dense features, by which the filter finds again what it follows; by default the packaged ones.
    """

    name = "quest"

    def __init__(
        self,
        network: FinderNetwork,
        config: TrackerConfig,
        *,
        device: torch.device,
        weights_hash: str | None = None,
        calibrations: Mapping[Inputs, Calibration] | None = None,
        noise: Noise | None = None,
        features: XFeat | None = None,
    ) -> None:
        self.network = network.to(device).eval()
        self.config = config
        self.device = device
        self.weights_hash = weights_hash
        self.calibrations: dict[Inputs, Calibration] = dict(calibrations or {})
        self.noise = Noise() if noise is None else noise
        self.features = (XFeat.from_package() if features is None else features).to(device)
        self._doubt = read_doubt(READINGS)

    def __repr__(self) -> str:
        weights = "unnamed weights" if self.weights_hash is None else f"weights {self.weights_hash[:8]}"
        monitor = f"monitored with {' and '.join(self.calibrations)}" if self.calibrations else "no monitor"
        return f"Tracker({self.name!r}, {weights}, on {self.device}, {monitor})"

    def stream(
        self,
        camera: Camera,
        queries: Sequence[Query] | None = None,
        *,
        online: bool | float | int = False,
        wait: bool = False,
        alpha: float | None = DEFAULT_ALPHA,
        alpha_frames: int | None = None,
    ) -> Stream:
        """Start tracking frames that come one by one.

        Args:
            camera: intrinsics of the frames.
            queries: what to follow; None discovers entities in the first frame.
            online: whether discovery goes on in later frames, every half second or every so many seconds of the
                stream's clock; ``queries`` are then None, and others are added to the stream.
            wait: whether a frame in which the finder looks waits for it, so that answers do not depend on the speed of
                the machine. Otherwise ``online`` looks in the background.
            alpha: probability of any alarm in a stream in which no identity is lost (``docs/monitor.md`` says what is
                promised); None for no alarms. Without a calibration for what the frames bring there are none either.
            alpha_frames: alpha is for every so many frames instead, such as 300 for ten seconds at 30 frames a second:
                alarms then come as readily late in a stream as early.

        Raises:
            InputError: a point query lies outside the image, or pictures have a side below 16 pixels.
            ConfigError: alpha is no probability, there are no frames, or ``online`` is no time or comes with queries.
        """
        finding = Finding.of(online, behind=not wait)
        if finding is not None and queries is not None:
            raise ConfigError("online: expected no queries, got some; leave out either, or add them to the stream")
        return Stream(
            self.network,
            self.features,
            self.noise,
            self.config,
            camera,
            queries,
            calibrations=self.calibrations,
            doubt=self._doubt,
            budget=None if alpha is None else Budget(alpha, alpha_frames),
            finding=finding,
        )

    def find(self, rgb: UInt8[np.ndarray, "H W 3"]) -> Found:
        """What can be taken hold of in a picture, however unlikely; nothing is followed.

        Args:
            rgb: the picture, sRGB.

        Returns:
            Best first; its ``logit`` is calibrated: the log odds of being right.

        Raises:
            InputError: the picture has another shape or type.
        """
        rgb = np.asarray(rgb)
        if rgb.ndim != 3 or rgb.shape[-1] != 3 or rgb.dtype != np.uint8 or not rgb.size:
            raise InputError(f"find: expected colours [H, W, 3] of uint8, got {list(rgb.shape)} of {rgb.dtype}")
        return find(self.network, rgb, size_px=self.config.size_px, odds=self.config)

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
        online: bool | float | int = False,
        alpha: float | None = DEFAULT_ALPHA,
        alpha_frames: int | None = None,
        report: Callable[[int], object] | None = None,
    ) -> Tracks:
        """Track a whole clip: the stream's step in a loop.

        Args:
            clip: the frames; or what :func:`quest.read` reads, by its path; or colours alone, [T, H, W, 3], as an array
                or tensor that :meth:`quest.Clip.from_arrays` takes.
            queries: what to follow; None discovers entities in the first frame.
            online: as in :meth:`stream`; each frame waits for the finder.
            alpha: as in :meth:`stream`.
            alpha_frames: as in :meth:`stream`; ``len(clip)`` shares alpha among all parts of the clip alike.
            report: called after every frame with the number of frames that are done.

        Raises:
            InputError: a point query lies outside the clip, or two queries have one name; or the frames are not as
                expected.
            TakeError: a path names a take that cannot be read.
            ConfigError: as in :meth:`stream`.
        """
        if isinstance(clip, str | Path):
            clip = read_recording(clip)
        elif not isinstance(clip, Clip):
            clip = Clip.from_arrays(clip)
        stream = self.stream(clip.camera, queries, online=online, wait=True, alpha=alpha, alpha_frames=alpha_frames)
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
        watched = {} if alpha is None else {inputs: each.to_json() for inputs, each in self.calibrations.items()}
        monitor = hashlib.sha256(repr(watched).encode()).hexdigest()
        return Maker(self.weights_hash, self.config, self.noise, REVISION, monitor, camera)


def load(
    name: str | Path = DEFAULT_WEIGHTS,
    *,
    device: str = "auto",
    monitor: bool | str | Path = True,
    engine: str | Path = "torch",
) -> Tracker:
    """A tracker from shipped weights, from a file, or from the Hugging Face hub.

    Args:
        name: name of shipped weights; path of a safetensors file or of a folder of a run; or ``owner/name`` of a model
            repository on the hub, optionally ``owner/name@revision``. What was fetched once works without a network.
        device: ``cpu``, ``cuda``, ``cuda:1``, ``mps``, or ``auto``: CUDA if there is any, else the CPU.
        monitor: whether to read the packaged calibrations of the monitor, without which there are no alarms; or the
            file of others that ``quest calibrate`` made.
        engine: what runs the networks: ``torch``; ``bfloat16``, the same in that precision, faster on processors and
            GPUs that have it; ``onnx``, which is ONNX Runtime on the processor; or the same from the path of a folder
            that ``quest export`` wrote.

    Raises:
        WeightsError: no such weights here or on the hub, the hub cannot be reached and the cache has no copy, or a
            file is torn, foreign, or of another shape; or the folder was exported from other weights.
        ConfigError: no such device, or ONNX Runtime is to run elsewhere than on the processor.
        MissingExtraError: ONNX Runtime is not installed.
    """
    if engine not in BY_TORCH and device not in ("auto", "cpu"):
        raise ConfigError(f"device {device!r}: ONNX Runtime runs on the processor; leave it out, or the engine")
    where = pick_device(device if engine in BY_TORCH else "cpu")
    loaded = load_network(name)
    network, features = networks(loaded, engine, where)
    calibrations = {} if monitor is False else read_calibrations(None if monitor is True else Path(monitor))
    for inputs, calibration in calibrations.items():
        if calibration.revision != REVISION:
            raise WeightsError(
                f"monitor: its calibration for {inputs} is of another filter (revision {calibration.revision}, this is "
                f"{REVISION}) and would promise nothing; run `quest calibrate`, or load without it"
            )
    return Tracker(
        network,
        TrackerConfig.from_json(loaded.settings),
        device=where,
        weights_hash=loaded.sha256,
        calibrations=calibrations,
        features=features,
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
        torch.zeros(1, device=device).item()  # also what holds no numbers
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
    nowhere = np.full((4, 4), np.nan)
    poses = np.stack([nowhere if s.cam_from_world is None else s.cam_from_world for s in states])
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
        joints=_joints(dict(zip(last.query, last.joint, strict=True)), point),
        cam_from_world=poses if np.isfinite(poses).any() else None,
    )


def _joints(joints: Mapping[int, Joint | None], point_world: Float32[np.ndarray, "T K 3"]) -> Joints:
    """The joints of the last frame by query as arrays, and where on them each frame was."""
    found = Joints.unknown(*point_world.shape[:2])
    kind = list(found.kind)
    for k, joint in joints.items():
        if joint is None:
            continue
        kind[k], found.origin[k], found.covariance[k] = joint.kind.value, joint.origin, joint.line_covariance
        if joint.kind is not JointKind.STATIC:
            found.axis[k], found.q_min_seen[k], found.q_max_seen[k] = joint.axis, joint.lower, joint.upper
            found.q[:, k] = joint.locate(point_world[:, k].astype(np.float64))
    return replace(found, kind=tuple(kind))
