"""Remember what a network saw in a frame, for evaluations that look at the same frames again."""

from __future__ import annotations

import hashlib
from collections.abc import Callable

from torch import Tensor

from quest.model.network import QuestNetwork
from quest.model.observation import FrameBatch, Observation


def remember_frames(network: QuestNetwork, *, capacity: int) -> None:
    """Make a network remember features and observations; its answers stay the same.

    Args:
        network: changed in place.
        capacity: frames to remember, 1.6 MB each and 1.2 MB where the affordance map is read; the oldest is forgotten
            first.
    """
    observe = network.observe
    observations: dict[bytes, Observation] = {}

    def remembering(encode: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
        features: dict[bytes, Tensor] = {}

        def remembered(rgb: Tensor) -> Tensor:
            key = _digest(rgb)
            if key not in features:
                _make_room(features, capacity)
                features[key] = encode(rgb)
            return features[key]

        return remembered

    def remembered_observe(frames: FrameBatch) -> Observation:
        key = _digest(frames.rgb, frames.depth_m, frames.ref_from_cam, frames.intrinsics, frames.center, frames.scale)
        if key not in observations:
            _make_room(observations, capacity)
            observations[key] = observe(frames)
        return observations[key]

    network.encode = remembering(network.encode)  # type: ignore[method-assign]
    network.enlarge = remembering(network.enlarge)  # type: ignore[method-assign]
    network.observe = remembered_observe  # type: ignore[method-assign]


def _make_room(known: dict, capacity: int) -> None:
    while len(known) >= capacity:
        del known[next(iter(known))]


def _digest(*tensors: Tensor) -> bytes:
    digest = hashlib.blake2b(digest_size=16)
    for tensor in tensors:
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.digest()
