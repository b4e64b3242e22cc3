"""Fit what several looks of the finder at one place are worth: the constants of ``quest.track.finding``.

    python benchmarks/fit_looks.py --pictures PICTURES --recordings RECORDINGS...

Labelled pictures that did not teach say how many of the finder's answers are right, and of how many things it says
nothing. Recordings are followed by the tracker; of two looks at one place, as many pairs as there are, the squared
difference of the log odds is fitted by twice the variance times one less the correlation, which falls by the descriptor
of the place. Writes ``benchmarks/results/looks.json``.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.optimize import curve_fit

import quest
from quest.data.cut import cut_clip
from quest.evaluation.real.measures import score_picture
from quest.evaluation.real.run import discover
from quest.evaluation.real.sets import open_set
from quest.track import Tracker
from quest.track.describing import described
from quest.track.preprocess import grey_of
from quest.track.queries import StreamQueries
from quest.types import LABELS, Query


@dataclass(frozen=True)
class FitLooks:
    """Fit the constants of online finding to pictures and recordings."""

    pictures: Path
    """Labelled set, of which the part that chooses is used."""
    recordings: tuple[Path, ...]
    """Folders of recordings."""
    frames: int = 46
    """Of each that are followed."""
    every: int = 5
    """Frames between looks."""
    most: int = 16
    """Places of each that are followed."""
    least: float = 0.02
    """Probability of those in the first frame."""
    out: Path = Path(__file__).parent / "results" / "looks.json"
    """Result file."""

    def run(self) -> int:
        """Fit, print, write."""
        tracker = quest.load(monitor=False)
        assert isinstance(tracker, Tracker)
        scored = [score_picture(p, discover(tracker, p.read())) for p in open_set(self.pictures).pictures]
        right, present = np.concatenate([s.first for s in scored]), sum(len(s.found) for s in scored)
        pairs = np.concatenate([self._pairs(tracker, path) for path in self.recordings])
        (variance, change), _ = curve_fit(expected, pairs[:, 0], pairs[:, 1], p0=(1.0, 0.1))
        result = {
            "right_of_answers": float(right.mean()),
            "answers": len(right),
            "overlooked": 1 - float(right.sum()) / present,
            "things": present,
            "variance": float(variance),
            "change": float(change),
            "pairs": len(pairs),
            "recordings": [path.name for path in self.recordings],
        }
        print(json.dumps(result, indent=1))
        self.out.write_text(json.dumps(result, indent=1) + "\n")
        return 0

    def _pairs(self, tracker: Tracker, path: Path) -> Float[np.ndarray, "N 2"]:
        """Cosine of the descriptors and squared difference of the log odds, of two looks at one place."""
        clip = cut_clip(quest.read(path), slice(0, self.frames))
        first = tracker.find(clip.rgb[0])
        keep = np.flatnonzero(np.isin(first.labels, LABELS) & (first.p > self.least))[: self.most]
        if not len(keep):
            return np.zeros((0, 2))
        tracks = tracker.track(clip, [Query.point(0, *first.uv_px[i]) for i in keep], alpha=None)
        queries, looks = StreamQueries(tracker.config, clip.camera, ()), []
        for t in range(0, len(clip), self.every):
            found = tracker.find(clip.rgb[t])
            found = found.select(np.isin(found.labels, LABELS))
            at_px = tracks.uv_px[t].astype(float)
            near = queries.near(found, at_px)
            says = np.where(near, found.logit[:, None], -np.inf).max(axis=0, initial=-np.inf)
            descriptor = described(tracker.features, grey_of(clip.rgb[t])).describe(at_px)
            looks.append((descriptor, np.where(tracks.visible[t] & np.isfinite(says), says, np.nan)))
        rows = [
            np.stack(((one[0] * other[0]).sum(axis=1), np.square(one[1] - other[1])), axis=-1)
            for one, other in combinations(looks, 2)
        ]
        return np.concatenate([row[np.isfinite(row).all(axis=1)] for row in rows])


def expected(cosine: Float[np.ndarray, " N"], variance: float, change: float) -> Float[np.ndarray, " N"]:
    """Squared difference of two looks whose errors have a variance and a correlation."""
    return 2 * variance * (1 - np.exp(np.minimum(cosine - 1, 0) / change))


if __name__ == "__main__":
    import sys

    import tyro

    sys.exit(tyro.cli(FitLooks).run())
