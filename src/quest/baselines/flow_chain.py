"""Flow chained with noise: x_{t+1} = x_t + f_t + e, with f_t from the network's scene flow head and e Gaussian.

The ablation of anchors: a track remembers nothing but its newest position, so that every error stays in it. In every
frame the query is bound anew to what is at x_t, looks at the newest T frames, and its flow takes it one frame on.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32

from quest.baselines.clip_frames import ClipFrames
from quest.baselines.point_queries import NO_DEPTH, check_point_queries, lift_pixels, project_points, query_names
from quest.baselines.redetect import NOTHING_FOUND, Detections, Detector
from quest.data.cut import cut_clip
from quest.errors import ConfigError, WeightsError
from quest.model.network import UNKNOWN_LABEL
from quest.model.observation import FrameBatch
from quest.types import Clip, Query, State, Tracks

if TYPE_CHECKING:
    from quest.data.store import TakeStore


class FlowChain:
    """Chains scene flow from a point query's lifted pixel, or from what is detected in frame 0.

    Args:
        detector: carries the network, and finds where to begin without queries.
        unit_m: metres per normalised unit of a clip, in which the noise is given (the object's size is the
            evaluation's to know).
        noise: standard deviation of e per coordinate, normalised units.
        seed: of the noise; every clip has a generator of its own, so that no answer depends on what was tracked before.
        name: what tables call it.

    Raises:
        WeightsError: the network has no flow head.
        ConfigError: the noise is negative.
    """

    protocols = ("point", "semantic")

    def __init__(
        self,
        detector: Detector,
        *,
        unit_m: Callable[[Clip], float],
        noise: float = 0.0,
        seed: int = 0,
        name: str = "flow-chain",
    ) -> None:
        if getattr(detector.network, "flow", None) is None:
            raise WeightsError(
                "flow-chain: expected weights with a flow head, got weights without; train one with stage 2"
            )
        if noise < 0:
            raise ConfigError(f"flow-chain: expected a noise of at least 0, got {noise}")
        self.detector = detector
        self.weights_hash = detector.weights_hash
        self.unit_m = unit_m
        self.noise = noise
        self.seed = seed
        self.name = name

    def track(self, clip: Clip, queries: Sequence[Query] | None = None) -> Tracks:
        """Chain flow from point queries, or from all detections of frame 0.

        Args:
            clip: frames; without depth there is no point to move, and pixels stay.
            queries: point queries; None follows all detections of frame 0.

        Returns:
            One track per query or detection; NaN before its frame. Where its pixel has no depth, a track waits at the
            pixel until there is some.

        Raises:
            ConfigError: a query that is not a point.
            InputError: a query outside the clip.
        """
        frames = self.detector.frames(clip)
        if queries is None:
            start = self.detector.detect(clip, self.detector.frames(clip), 0)
            first, uv_first = np.zeros(len(start.label), np.int64), start.uv_px
        else:
            start = None
            first, uv_first = check_point_queries(clip, queries, tracker=self.name)
        point = self._chain(clip, frames, first, uv_first)
        begun = np.arange(len(clip))[:, None] >= first
        seen = project_points(clip, point)
        uv_px = np.where(np.isfinite(seen), seen, np.broadcast_to(uv_first, seen.shape))
        flags = (NO_DEPTH,) if clip.depth_m is None else ()
        names, labels, confidence, found = _heads(start, queries)
        return Tracks(
            names=names,
            labels=labels,
            uv_px=np.where(begun[..., None], uv_px, np.nan).astype(np.float32),
            point_world=point,
            confidence=begun * confidence,
            visible=begun,
            state=np.where(begun, State.TRACKING.value, State.LOST.value),
            stamp_s=clip.stamp_s,
            frame_flags=flags + found,
        )

    def _chain(
        self, clip: Clip, frames: ClipFrames, first: np.ndarray, uv_first: Float32[np.ndarray, "K 2"]
    ) -> Float32[np.ndarray, "T K 3"]:
        """World points; NaN before the first frame and where there never was depth."""
        rng = np.random.default_rng([self.seed, zlib.crc32(clip.name.encode())])
        sigma_m = self.noise * self.unit_m(clip)
        found = np.full((len(clip), len(first), 3), np.nan, np.float64)
        for t in range(len(clip) if len(first) else 0):
            unknown = (first <= t) & ~np.isfinite(found[t]).all(axis=-1)
            if unknown.any():
                lifted = lift_pixels(
                    cut_clip(clip, slice(t, t + 1)), uv_first[None], window_px=self.detector.depth_window_px
                )[0]
                found[t, unknown] = lifted[unknown]
            step = self._flow(frames, t, found[t])
            noise = rng.normal(0.0, 1.0, step.shape) * sigma_m
            if t + 1 < len(clip):
                found[t + 1] = found[t] + step + noise
        return found.astype(np.float32)

    def _flow(self, frames: ClipFrames, t: int, point_world: Float[np.ndarray, "K 3"]) -> Float[np.ndarray, "K 3"]:
        """World displacement to the next frame of what is at points now; 0 where nothing is known."""
        network, detector = self.detector.network, self.detector
        valid = np.asarray(np.isfinite(point_world).all(axis=-1))
        with torch.inference_mode(), torch.autocast(detector.device.type, torch.bfloat16, enabled=detector.autocast):
            batch, observed = frames.see(t)
            if not valid.any():
                return np.zeros_like(point_world)
            point = frames.to_reference(np.where(valid[:, None], point_world, 0.0))
            uv = _project(batch, point, size=frames.letterbox.size)
            asked = torch.from_numpy(valid).to(point.device) & torch.isfinite(uv).all(dim=-1)
            label = torch.full((1, len(point)), UNKNOWN_LABEL, device=point.device)
            anchor = network.bind(observed, uv.nan_to_num(0.5).clamp(0, 1)[None], point[None], label, asked[None])
            seen = network.decode(anchor, frames.window())
            moved = network.displace(seen.embedding, seen.point)[0].float()
        return _where(asked, frames.to_world(moved))


def _where(asked: torch.Tensor, step: Float[np.ndarray, "K 3"]) -> Float[np.ndarray, "K 3"]:
    known: Bool[np.ndarray, " K"] = asked.cpu().numpy() & np.isfinite(step).all(axis=-1)
    return np.where(known[:, None], step, 0.0)


def _project(batch: FrameBatch, point: Float[torch.Tensor, "K 3"], *, size: int) -> Float[torch.Tensor, "K 2"]:
    """Coordinates in [0, 1]^2 of the input; NaN behind the camera."""
    return batch.from_reference(point[None, None])[0, 0] / size


def _heads(
    start: Detections | None, queries: Sequence[Query] | None
) -> tuple[tuple[str, ...], tuple[str | None, ...], Float32[np.ndarray, " K"], tuple[str, ...]]:
    """Names, labels and confidences of the tracks, and what must be said of them."""
    if start is not None:
        names = tuple(f"{label} {k}" for k, label in enumerate(start.label))
        return names, start.label, start.confidence, () if names else (NOTHING_FOUND,)
    assert queries is not None
    return query_names(queries), tuple(q.label for q in queries), np.ones(len(queries), np.float32), ()


def units_of(stores: Sequence[TakeStore]) -> Callable[[Clip], float]:
    """Metres per normalised unit of the clips of stores, by their names."""
    known: Mapping[str, float] = {
        clip: header.info.half_diagonal_m
        for store in stores
        for header in store.headers().values()
        for clip in header.clip_names
    }

    def unit_m(clip: Clip) -> float:
        if clip.name not in known:
            raise ConfigError(f"clip {clip.name!r}: expected one of the stores at hand, which say how large it is")
        return known[clip.name]

    return unit_m
