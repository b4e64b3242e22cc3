"""Which windows a batch is made of and how they are disturbed, before anything large is read.

A plan is drawn for the whole batch from one generator. It can then be divided among processes and micro-batches, which
together have exactly the windows, the padding and the disturbances that one process would have had.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float32

from quest.train.feature_cache import CachedView
from quest.train.settings import WindowConfig

Pick = tuple[CachedView, list[int]]
"""A view and frames of it: the anchor first, then the window, oldest first."""


@dataclass(frozen=True)
class Disturbance:
    """What is random about windows beyond the choice of frames."""

    no_depth: Bool[np.ndarray, " B"]
    """Windows that lose all depth."""
    gain: Float32[np.ndarray, "B 1 1 1 3"]
    """Factor of each colour channel."""
    untold: Bool[np.ndarray, "B K"]
    """Queries that are not told their label."""
    untold_intent: Bool[np.ndarray, "B K"]
    """Queries that are not told their intent."""
    noise_px: Float32[np.ndarray, "B K 2"]
    """Displacement of the anchors, pixels of the input."""
    left_out: Bool[np.ndarray, "B K"]
    """Queries that are not asked for."""


@dataclass(frozen=True)
class WindowPlan:
    """Windows to be read."""

    picks: tuple[Pick, ...]
    """A view and its frames, per window."""
    following: tuple[int, ...]
    """The frame after the window at the step of its newest frames; -1 where the view has none."""
    entities: int
    """Entities of the fullest view of the whole batch, to which all windows are padded."""
    disturbance: Disturbance | None
    """None for windows as they are."""

    def __len__(self) -> int:
        return len(self.picks)

    def part(self, windows: slice) -> WindowPlan:
        """Some of the windows, padded and disturbed as in the whole."""
        d = self.disturbance
        if d is not None:
            d = Disturbance(**{f.name: getattr(d, f.name)[windows] for f in fields(d)})
        return replace(self, picks=self.picks[windows], following=self.following[windows], disturbance=d)


def draw_disturbance(rng: np.random.Generator, config: WindowConfig, *, windows: int, entities: int) -> Disturbance:
    """Disturbances of a batch.

    Args:
        rng: generator to draw from.
        config: how much.
        windows: how many windows.
        entities: how many queries each, padding included.
    """
    queries = (windows, entities)
    return Disturbance(
        no_depth=rng.random(windows) < config.depth_drop_share,
        gain=1 + config.colour_jitter * rng.uniform(-1, 1, (windows, 1, 1, 1, 3)).astype(np.float32),
        untold=rng.random(queries) >= config.label_share,
        untold_intent=rng.random(queries) >= config.label_share,
        noise_px=rng.normal(0, config.point_jitter_px, (*queries, 2)).astype(np.float32),
        left_out=rng.random(queries) < config.query_drop_share,
    )
