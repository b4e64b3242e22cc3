"""Evidence of appearance: how much more probable a place is the entity than something else, by what it looks like.

Two likenesses to the anchor are read off: the cosine of dense descriptors, which see some tens of pixels, and the
correlation of the grey values close by, which tells what is occluded. Each counts by the logarithm of what it falls
short of one. Their weighted sum is the log-odds of a place against *none*, in a conditional logit over some places.

Reference: McFadden, Conditional logit analysis of qualitative choice behavior, 1974.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float

from quest.filter.noise import Noise
from quest.filter.picture import Picture

PATCH_PX = 13
_REACH_CELLS = 3
_REACH_PX = 4
CELL_REACH_PX = 6
"""How far from the middle of a cell a place is looked for in it."""
_SHORT = 0.02
"""How near to one a likeness is told apart from one."""


@dataclass(frozen=True)
class Likeness:
    """How like K anchors a frame is."""

    picture: Picture
    cosine: Float[np.ndarray, "K h w"]
    """Of each cell's descriptor with that of the most like view."""
    patch: Float[np.ndarray, "K V S S"]
    """Grey values around the entity in some views."""

    @classmethod
    def of(
        cls, picture: Picture, descriptor: Float[np.ndarray, "K V D"], patch: Float[np.ndarray, "K V S S"]
    ) -> Likeness:
        """Compare a frame with views of entities."""
        # Not by NumPy: threads of OpenBLAS keep all cores busy with waiting long after such a product.
        one, other = torch.from_numpy(descriptor).float(), torch.from_numpy(picture.descriptors)
        cosine = torch.einsum("kvd,dhw->kvhw", one, other).amax(dim=1).numpy()
        return cls(picture, cosine, patch)

    def at(self, uv_px: Float[np.ndarray, "K C 2"], noise: Noise, reach_px: int = _REACH_PX) -> Places:
        """How like the anchor C places of each query are; the best correlation may be ``reach_px`` off."""
        best_px, wide, near = self.terms(uv_px, reach_px)
        return Places(best_px, noise.look_bias + noise.look_wide * wide + noise.look_near * near)

    def terms(
        self, uv_px: Float[np.ndarray, "K C 2"], reach_px: int = _REACH_PX
    ) -> tuple[Float[np.ndarray, "K C 2"], Float[np.ndarray, "K C"], Float[np.ndarray, "K C"]]:
        """Where the correlation is best, and the logarithms of what the cosine and it fall short of one, negative."""
        count, places = uv_px.shape[:2]
        rows, columns = self.cosine.shape[1:]
        around = np.array([cv2.dilate(each, np.ones((3, 3), np.uint8)) for each in self.cosine])
        cell = np.floor(uv_px / self.picture.cell_px).astype(np.int64).clip(0, (columns - 1, rows - 1))
        cosine = around[np.arange(count)[:, None], cell[..., 1], cell[..., 0]]
        best = [
            max(
                (
                    cv2.minMaxLoc(cv2.matchTemplate(each, view, cv2.TM_CCOEFF_NORMED))
                    for view in self.patch[i // places]
                ),
                key=lambda found: found[1],
            )
            for i, each in enumerate(self.picture.patches(uv_px.reshape(-1, 2), PATCH_PX + 2 * reach_px))
        ]
        correlation = np.array([each[1] for each in best]).reshape(count, places)
        shift = np.array([each[3] for each in best], dtype=np.float64).reshape(count, places, 2) - reach_px
        wide, near = (-np.log(1 + _SHORT - each.clip(-1, 1)) for each in (cosine.astype(np.float64), correlation))
        return uv_px + shift, wide, near

    def elsewhere_px(self, uv_px: Float[np.ndarray, "K 2"], count: int) -> Float[np.ndarray, "K C 2"]:
        """The cells most like the anchor, none of them near where it is followed, or near another."""
        cosine, cells = self.cosine.copy(), []
        rows, columns = cosine.shape[1:]
        at = np.floor(uv_px / self.picture.cell_px).astype(np.int64).clip(0, (columns - 1, rows - 1))
        row, column = np.arange(rows)[None, :, None], np.arange(columns)[None, None]
        for _ in range(count):
            off = np.maximum(abs(row - at[:, 1, None, None]), abs(column - at[:, 0, None, None]))
            cosine[off <= _REACH_CELLS] = -1
            at = np.stack(np.unravel_index(cosine.reshape(len(at), -1).argmax(axis=1), (rows, columns))[::-1], axis=-1)
            cells.append((at + 0.5) * self.picture.cell_px)
        return np.stack(cells, axis=1)

    def elsewhere(self, uv_px: Float[np.ndarray, "K 2"], count: int, noise: Noise) -> Places:
        """How like the anchor the likest places elsewhere are."""
        found = self.at(self.elsewhere_px(uv_px, count), noise, CELL_REACH_PX)
        return Places(found.uv_px, found.log_odds + noise.jump_log_odds)


@dataclass(frozen=True)
class Places:
    """C places of K queries, and how like the anchor they are."""

    uv_px: Float[np.ndarray, "K C 2"]
    """Where the correlation is highest."""
    log_odds: Float[np.ndarray, "K C"]
    """That the entity is there and seen, against that it is not."""
