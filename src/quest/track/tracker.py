"""The tracker a user holds."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from quest.errors import ConfigError, InputError
from quest.model.network import QuestNetwork
from quest.model.weights import load_network
from quest.track.settings import TrackerConfig
from quest.track.state import StreamState
from quest.track.stream import Stream
from quest.types import Camera, Clip, Query, State, Tracks

DEFAULT_WEIGHTS = "quest-s16"
NO_DEPTH_FLAG = "no depth: pixels only, world points are NaN"
PARTLY_NO_DEPTH_FLAG = "depth missing in some frames: world points there are NaN"
NOTHING_FOUND_FLAG = "discovery found no entity in the first frame; give a point or a label"


class Tracker:
    """Follows entities through clips and streams; make one with :func:`load`.

    Args:
        network: trained network.
        config: settings of tracking.
        device: where the network runs.
        weights_hash: SHA-256 of the file that the network came from, for result files.
    """

    name = "quest"

    def __init__(
        self, network: QuestNetwork, config: TrackerConfig, *, device: torch.device, weights_hash: str | None = None
    ) -> None:
        self.network = network.to(device).eval()
        self.config = config
        self.device = device
        self.weights_hash = weights_hash
        self._autocast = fast_bfloat16(device)

    def stream(self, camera: Camera, queries: Sequence[Query] | None = None) -> Stream:
        """Start tracking frames that come one by one.

        Args:
            camera: intrinsics of the frames.
            queries: what to follow; None discovers entities in the first frame.

        Raises:
            InputError: a point query lies outside the image.
        """
        return Stream(self.network, self.config, camera, queries, device=self.device, autocast=self._autocast)

    def track(self, clip: Clip, queries: Sequence[Query] | None = None) -> Tracks:
        """Track a whole clip: the stream's step in a loop.

        Args:
            clip: the frames.
            queries: what to follow; None discovers entities in the first frame.

        Raises:
            InputError: a point query lies outside the clip.
        """
        for query in queries or ():
            if query.frame >= len(clip):
                raise InputError(
                    f"clip {clip.name!r}: query at frame {query.frame}, but the clip has {len(clip)} frames"
                )
        stream = self.stream(clip.camera, queries)
        states = []
        for t in range(len(clip)):
            frame = clip.frame(t)
            states.append(stream.step(frame.rgb, frame.depth_m, frame.stamp_s, frame.cam_from_world))
        return collect(states, queries)


def load(name: str | Path = DEFAULT_WEIGHTS, *, device: str = "auto") -> Tracker:
    """A tracker from shipped weights or from a file.

    Args:
        name: name of shipped weights, or path of a safetensors file that ``quest train`` wrote.
        device: ``cpu``, ``cuda``, ``cuda:1``, ``mps``, or ``auto`` for the best there is.

    Raises:
        WeightsError: no such weights, or the file is torn, foreign, or of another shape.
        ConfigError: no such device.
    """
    loaded = load_network(name)
    config = TrackerConfig.from_json(loaded.settings)
    return Tracker(loaded.network, config, device=pick_device(device), weights_hash=loaded.sha256)


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


def fast_bfloat16(device: torch.device) -> bool:
    """Whether bfloat16 is faster than float32 there."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported()
    if device.type != "cpu" or not torch.backends.mkldnn.is_available():
        return False
    return bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())


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
    confidence = np.zeros((t, k), np.float32)
    visible = np.zeros((t, k), bool)
    state = np.full((t, k), State.LOST.value, dtype="<U8")
    for i, s in enumerate(states):
        rows = list(s.query)
        uv[i, rows], point[i, rows] = s.uv_px, s.point_world
        confidence[i, rows], visible[i, rows] = s.confidence, s.visible
        state[i, rows] = [value.value for value in s.state]
    with_depth = [s.has_depth for s in states]
    flags = [] if all(with_depth) else [PARTLY_NO_DEPTH_FLAG if any(with_depth) else NO_DEPTH_FLAG]
    lost = [names[i] for i in range(k) if i not in last.query]
    flags += [f"query {name!r} found no entity: lost in every frame" for name in lost]
    flags += [NOTHING_FOUND_FLAG] if queries is None and not k else []
    stamps = np.array([s.stamp_s for s in states])
    return Tracks(tuple(names), tuple(labels), uv, point, confidence, visible, state, stamps, tuple(flags))
