"""The encoder's answers read from a feature cache, for many networks that share one frozen encoder."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from quest.model.config import DecoderConfig
from quest.model.network import WindowNetwork
from quest.train.feature_cache import CachedView


class CachedEncoder:
    """Looks frames up by their letterboxed colours.

    Args:
        views: prepared views, made with the encoder of the networks that will use them.
    """

    def __init__(self, views: Sequence[CachedView]) -> None:
        self._place: dict[bytes, tuple[CachedView, int]] = {}
        for view in views:
            for t, image in enumerate(view.rgb):
                self._place[_digest(image)] = (view, t)

    def serve(self, network: WindowNetwork[DecoderConfig]) -> None:
        """Make a network read features instead of computing them; frames that are not there are still encoded.

        Args:
            network: changed in place. Its encoder must be the one that made the cache.
        """
        encode = network.encode

        def read(rgb: Tensor) -> Tensor:
            places = [self._place.get(_digest(image)) for image in rgb.cpu().numpy()]
            if any(place is None for place in places):
                return encode(rgb)
            features = [view.features[t] for view, t in (place for place in places if place is not None)]
            return torch.from_numpy(np.stack(features)).to(rgb.device).float()

        network.encode = read  # type: ignore[method-assign]


def _digest(image: np.ndarray) -> bytes:
    return hashlib.blake2b(np.ascontiguousarray(image).data, digest_size=16).digest()
