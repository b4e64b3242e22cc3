"""Every frame matched to the query's own by dense features; nothing is chained.

Reference of the matching of tokens: Amir et al., Deep ViT features as dense visual descriptors, 2021.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Float32, Int, UInt8
from torch import Tensor

from quest.baselines.point_queries import Followed, PointTracker
from quest.model.encoder import Encoder
from quest.model.xfeat import XFeat, sample
from quest.track import Tracker
from quest.types import Clip

LEAST_SIMILARITY = 0.6
"""Cosine above which the best match is said to be the point; set beforehand, not tuned on any recording."""
TOKEN_BLOCK = 8
"""Index of the block, the ninth, of the vision transformer whose tokens are matched."""
LONGEST_PX = 640
"""Longer side of the picture that the vision transformer sees."""
_FINER = 4
Colours = UInt8[np.ndarray, "H W 3"]


class DenseMatch(PointTracker):
    """Answers with the most similar place of the whole picture, be it similar or not; visible is what is similar.

    Args:
        name: what tables call it.
        features: descriptors of length 1 of a picture, in cells from corner to corner of it.
        weights_hash: SHA-256 of the weights, where they are the user's choice.
    """

    def __init__(
        self, name: str, features: Callable[[Colours], Float[Tensor, "D h w"]], *, weights_hash: str | None = None
    ) -> None:
        self.name, self.features, self.weights_hash = name, features, weights_hash

    @classmethod
    def by_xfeat(cls) -> DenseMatch:
        """By the packaged network of XFeat."""
        return cls("xfeat", partial(xfeat_features, XFeat.from_package()))

    @classmethod
    def by_tokens(cls, name: str, tracker: Tracker) -> DenseMatch:
        """By tokens of the vision transformer in a tracker's network."""
        return cls(name, partial(token_features, tracker.network.encoder), weights_hash=tracker.weights_hash)

    @torch.no_grad()
    def follow(self, clip: Clip, first: Int[np.ndarray, " K"], uv_first: Float32[np.ndarray, "K 2"]) -> Followed:
        """Match each point in every frame after its own; confidence is the similarity.

        Raises:
            InputError: pictures with a side below 16 pixels (XFeat).
        """
        t, k = len(clip), len(first)
        size = (clip.camera.width, clip.camera.height)
        uv_px, confidence = np.full((t, k, 2), np.nan, np.float32), np.zeros((t, k), np.float32)
        wanted = None
        for i, rgb in enumerate(clip.rgb):
            features = self.features(rgb)
            wanted = features.new_zeros(k, len(features)) if wanted is None else wanted
            known, born = np.flatnonzero(first < i), np.flatnonzero(first == i)
            uv_px[i, known], confidence[i, known] = best_match(features, wanted[known], size)
            wanted[born] = sample(features, torch.from_numpy(uv_first[born]).to(features.device), size)
        return uv_px, confidence > LEAST_SIMILARITY, confidence


def xfeat_features(network: XFeat, rgb: UInt8[np.ndarray, "H W 3"]) -> Float[Tensor, "D h w"]:
    """Descriptors of XFeat."""
    grey = rgb.mean(axis=-1, dtype=np.float32).astype(np.uint8)
    return network.features(torch.from_numpy(grey))[0]


def token_features(encoder: Encoder, rgb: UInt8[np.ndarray, "H W 3"]) -> Float[Tensor, "D h w"]:
    """Tokens of a vision transformer, bilinear between patches, of length 1: four cells along each side of a patch.

    The picture is resized to :data:`LONGEST_PX` and whole patches.
    """
    patch, zoom = encoder.config.patch_size, LONGEST_PX / max(rgb.shape)
    size = [max(1, round(zoom * side / patch)) * patch for side in rgb.shape[:2]]
    picture = torch.from_numpy(np.ascontiguousarray(rgb)).to(encoder.mean.device).permute(2, 0, 1)[None] / 255
    picture = F.interpolate(picture, size, mode="bilinear", align_corners=False, antialias=True)
    tokens = encoder.depths(picture, (TOKEN_BLOCK,))
    return F.normalize(F.interpolate(tokens, scale_factor=_FINER, mode="bilinear", align_corners=False)[0], dim=0)


def best_match(
    features: Float[Tensor, "D h w"], wanted: Float[Tensor, "M D"], size: tuple[int, int]
) -> tuple[Float32[np.ndarray, "M 2"], Float32[np.ndarray, " M"]]:
    """Pixel of the most similar cell, refined by a parabola along each axis, and its similarity from 0 to 1."""
    height, width = features.shape[1:]
    flat = (wanted @ features.flatten(1)).cpu().numpy()
    each, (rows, columns) = np.arange(len(flat)), np.divmod(flat.argmax(axis=1), width)
    # Mirrored, so that nothing is refined across a border.
    padded, best = np.pad(flat.reshape(-1, height, width), ((0, 0), (1, 1), (1, 1)), mode="reflect"), flat.max(axis=1)
    before = np.stack((padded[each, rows + 1, columns], padded[each, rows, columns + 1]), axis=-1)
    after = np.stack((padded[each, rows + 1, columns + 2], padded[each, rows + 2, columns + 1]), axis=-1)
    bend = np.maximum(2 * best[:, None] - before - after, 1e-9)
    cell = np.stack((columns, rows), axis=-1) + 0.5 + (after - before) / (2 * bend)
    return (cell * np.divide(size, (width, height))).astype(np.float32), best.clip(0, 1)
