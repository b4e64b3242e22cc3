"""Which windows a batch is made of, before anything large is read.

A plan is drawn for the whole batch from one generator. It can then be divided among processes and micro-batches, which
together have exactly the windows, the padding and the disturbances that one process would have had.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool

from quest.train.feature_cache import CachedView

Pick = tuple[CachedView, list[int]]
"""A view and frames of it: the anchor first, then the window, oldest first."""


@dataclass(frozen=True)
class WindowPlan:
    """Windows to be read."""

    picks: tuple[Pick, ...]
    """A view and its frames, per window."""
    following: tuple[int, ...]
    """The frame after the window at the step of its newest frames; -1 where the view has none."""
    entities: int
    """Entities of the fullest view of the whole batch, to which all windows are padded."""
    no_depth: Bool[np.ndarray, " B"]
    """Windows that lose all depth."""

    def __len__(self) -> int:
        return len(self.picks)

    def part(self, windows: slice) -> WindowPlan:
        """Some of the windows, padded and disturbed as in the whole."""
        return replace(
            self, picks=self.picks[windows], following=self.following[windows], no_depth=self.no_depth[windows]
        )
