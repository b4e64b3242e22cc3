"""Trackers that only tables need: of colours that were made noisy, and of the true motion made noisy."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from quest.baselines import ClipTracker
from quest.baselines.point_queries import answers, check_point_queries, project_points
from quest.errors import ConfigError
from quest.types import Clip, Query, Take, Tracks


@dataclass(frozen=True)
class NoisyColours:
    """A tracker that is shown colours with Gaussian noise; of a clip and seed the noise is always the same."""

    tracker: ClipTracker
    noise: float
    """Standard deviation, as a share of the range of the colours."""
    seed: int = 0

    @property
    def name(self) -> str:
        """As of the tracker."""
        return self.tracker.name

    @property
    def protocols(self) -> tuple[str, ...]:
        """As of the tracker."""
        return getattr(self.tracker, "protocols", ("point", "semantic"))

    def track(self, clip: Clip, queries: Sequence[Query] | None = None) -> Tracks:
        """What the tracker answers."""
        rng = _generator(self.seed, clip.name)
        rgb = np.empty_like(clip.rgb)
        for t, image in enumerate(clip.rgb):
            noisy = image + 255 * self.noise * rng.standard_normal(image.shape, np.float32)
            rgb[t] = np.clip(np.rint(noisy), 0, 255)
        return self.tracker.track(replace(clip, rgb=rgb), queries)


@dataclass(frozen=True)
class ChainedFlow:
    """The true displacement of each entity from frame to frame, with Gaussian noise on every step, added up.

    It bounds what any tracker reaches that chains scene flow of such errors and holds no query.
    """

    noise: float
    """Standard deviation of each coordinate of a step, in half diagonals of the object."""
    seed: int = 0
    name: str = "flow"
    protocols: tuple[str, ...] = ("point",)

    truth: tuple[Take, int] | None = None
    """A take, and the view of it."""

    def told(self, take: Take, view: int) -> ClipTracker:
        """The same, knowing the truth of a take."""
        return replace(self, truth=(take, view))

    def track(self, clip: Clip, queries: Sequence[Query] | None = None) -> Tracks:
        """What the entities nearest to the queries do, and noise that adds up; only when it is :meth:`told`."""
        if self.truth is None:
            raise ConfigError("tracker 'flow': it chains the true flow and can only be judged on takes")
        first, uv_first = check_point_queries(clip, queries, tracker=self.name)
        assert queries is not None
        take, view = self.truth
        asked = [_nearest(take, view, int(t), uv) for t, uv in zip(first, uv_first, strict=True)]
        rng = _generator(self.seed, take.info.name, str(view))
        step = rng.normal(0.0, self.noise * take.info.half_diagonal_m, (len(clip), len(asked), 3))
        step[np.arange(len(clip))[:, None] <= first] = 0.0
        point = (take.point_world[:, asked] + step.cumsum(axis=0)).astype(np.float32)
        visible, uv_px = np.ones(point.shape[:2], bool), project_points(clip, point)
        sure = visible.astype(np.float32)
        return answers(clip, queries, uv_px=uv_px, point_world=point, visible=visible, confidence=sure)


def _nearest(take: Take, view: int, frame: int, uv_px: np.ndarray) -> int:
    """The tracked entity whose true pixel is nearest to one."""
    gap = np.linalg.norm(take.views[view].uv_px[frame, take.tracked] - uv_px, axis=-1)
    return int(take.tracked[np.nanargmin(gap)])


def _generator(seed: int, *names: str) -> np.random.Generator:
    digest = hashlib.blake2b("/".join(names).encode(), digest_size=8).digest()
    return np.random.default_rng([seed, int.from_bytes(digest, "little")])
