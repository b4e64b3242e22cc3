"""Evidence of appearance: how much more probable a place is the entity than something else, by what it looks like.

Two likenesses to the anchor are read off: the cosine of dense descriptors, which see some tens of pixels, and the
correlation of the grey values close by, which tells what is occluded. Each counts by the logarithm of what it falls
short of one. Their weighted sum is the log-odds of a place against *none*, in a conditional logit over some places.

Reference: McFadden, Conditional logit analysis of qualitative choice behavior, 1974.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int

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
    by_view: Float[np.ndarray, "K V h w"]
    """Cosine of each cell's descriptor with that of each view."""
    patch: Float[np.ndarray, "K V S S"]
    """Grey values around the entity in some views."""

    @classmethod
    def of(
        cls, picture: Picture, descriptor: Float[np.ndarray, "K V D"], patch: Float[np.ndarray, "K V S S"]
    ) -> Likeness:
        """Compare a frame with views of entities."""
        # Not by NumPy: threads of OpenBLAS keep all cores busy with waiting long after such a product.
        one, other = torch.from_numpy(descriptor).float(), torch.from_numpy(picture.descriptors)
        return cls(picture, torch.einsum("kvd,dhw->kvhw", one, other).numpy(), patch)

    @cached_property
    def cosine(self) -> Float[np.ndarray, "K h w"]:
        """Of each cell's descriptor with that of the most like view."""
        return np.asarray(self.by_view.max(axis=1))

    def at(self, uv_px: Float[np.ndarray, "K C 2"], noise: Noise, reach_px: int = _REACH_PX) -> Places:
        """How like the anchor C places of each query are; the best correlation may be ``reach_px`` off."""
        best_px, wide, near = self.terms(uv_px, reach_px)
        return Places(best_px, noise.look_bias + noise.look_wide * wide + noise.look_near * near)

    def terms(
        self, uv_px: Float[np.ndarray, "K C 2"], reach_px: int = _REACH_PX
    ) -> tuple[Float[np.ndarray, "K C 2"], Float[np.ndarray, "K C"], Float[np.ndarray, "K C"]]:
        """Where the correlation is best, and the logarithms of what the cosine and it fall short of one, negative."""
        count, places = uv_px.shape[:2]
        around = np.array([cv2.dilate(each, np.ones((3, 3), np.uint8)) for each in self.cosine])
        column, row = np.moveaxis(self._cell(uv_px), -1, 0)
        cosine = around[np.arange(count)[:, None], row, column]
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

    def by_each_view(
        self, uv_px: Float[np.ndarray, "K 2"]
    ) -> tuple[Float[np.ndarray, "K V"], Float[np.ndarray, "K V"], Float[np.ndarray, "K V"]]:
        """How like each view a place is.

        Returns:
            The cosine; the logarithm of what the correlation falls short of one, negative; the best cosine elsewhere.
        """
        count, views = self.by_view.shape[:2]
        flat = self.by_view.reshape(count * views, *self.by_view.shape[2:])
        alone = Likeness(self.picture, flat[:, None], self.patch.reshape(-1, 1, *self.patch.shape[2:]))
        at_px = np.repeat(uv_px, views, axis=0)
        _, wide, near = alone.terms(at_px[:, None])
        best = alone.terms(alone.elsewhere_px(at_px, 1))[1]
        cosine, other = (1 + _SHORT - np.exp(-each.reshape(count, views)) for each in (wide, best))
        return cosine, near.reshape(count, views), other

    def elsewhere_px(self, uv_px: Float[np.ndarray, "K 2"], count: int) -> Float[np.ndarray, "K C 2"]:
        """The cells most like the anchor, none of them near where it is followed, or near another."""
        cosine, cells = self.cosine.copy(), []
        rows, columns = cosine.shape[1:]
        at = self._cell(uv_px)
        row, column = np.arange(rows)[None, :, None], np.arange(columns)[None, None]
        for _ in range(count):
            off = np.maximum(abs(row - at[:, 1, None, None]), abs(column - at[:, 0, None, None]))
            cosine[off <= _REACH_CELLS] = -1
            at = np.stack(np.unravel_index(cosine.reshape(len(at), -1).argmax(axis=1), (rows, columns))[::-1], axis=-1)
            cells.append((at + 0.5) * self.picture.cell_px)
        return np.stack(cells, axis=1)

    def _cell(self, uv_px: Float[np.ndarray, "*N 2"]) -> Int[np.ndarray, "*N 2"]:
        """Column and row of the cell of each place."""
        rows, columns = self.by_view.shape[2:]
        return np.floor(uv_px / self.picture.cell_px).astype(np.int64).clip(0, (columns - 1, rows - 1))

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
