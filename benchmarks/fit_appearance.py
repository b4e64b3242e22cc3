"""Fit what a likeness is worth: the parameters ``look_*`` and ``jump_log_odds`` of the filter's noise.

    python benchmarks/fit_appearance.py RECORDINGS...

Recordings with depth and poses are their own teachers: where a corner of one frame is in another one is known, and
whether something is in front of it. For pairs of frames of a still scene the conditional logit is fitted by maximum
likelihood to which of some places is the corner: its true place, a place beside it, the likest places elsewhere, or
none of them. Each recording is also predicted by a fit to the others. Writes ``benchmarks/results/appearance.json``.

Reference: McFadden, Conditional logit analysis of qualitative choice behavior, 1974.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Float, Int
from scipy.optimize import minimize

from quest.data.recording import read_recording
from quest.filter.appearance import CELL_REACH_PX, PATCH_PX, Likeness
from quest.filter.local_motion import corners
from quest.filter.posterior import RIVALS
from quest.filter.view import View, in_image
from quest.model.xfeat import XFeat
from quest.track.describing import described
from quest.track.preprocess import grey_of
from quest.types import Clip

NAMES = ("look_wide", "look_near", "look_bias", "jump_log_odds")
NEAR_PX = 16.0
OCCLUDED_TIMES = 5.0
"""How much a corner behind something counts: there are few, and on these rests what is said to be visible."""


@dataclass(frozen=True)
class Choices:
    """N choices between a place where a corner is followed, places elsewhere, and none."""

    terms: Float[np.ndarray, "N C 2"]
    """Of the place first, then of those elsewhere."""
    right: Int[np.ndarray, " N"]
    """Index of the right place; C where it is none of them."""
    weight: Float[np.ndarray, " N"]


@dataclass(frozen=True)
class FitAppearance:
    """Fit the filter's parameters of appearance to recordings with depth and poses."""

    recordings: tyro.conf.Positional[list[Path]]
    """Folders of recordings of still scenes."""
    frames: int = 40
    """Most frames of each that are compared."""
    corners: int = 25
    """Corners of each of every fifth of them."""
    seed: int = 0
    out: Path = Path(__file__).parent / "results" / "appearance.json"
    features: tyro.conf.Suppress[XFeat] = field(default_factory=XFeat.from_package)

    def main(self) -> None:
        """Collect, fit, write and print."""
        rng = np.random.default_rng(self.seed)
        choices = {path.name: self.choices(read_recording(path), rng) for path in self.recordings}
        every = list(choices.values())
        fitted = fit(every)
        held_out = {name: loss(fit([c for c in every if c is not choices[name]]), choices[name]) for name in choices}
        share = np.bincount(np.concatenate([c.right for c in every]), minlength=RIVALS + 2) / sum(map(count, every))
        result = {
            "parameters": dict(zip(NAMES, map(float, fitted.round(2)), strict=True)),
            "choices": {name: count(c) for name, c in choices.items()},
            "log_loss": sum(loss(fitted, c) * count(c) for c in every) / sum(map(count, every)),
            "log_loss_held_out": held_out,
            "log_loss_of_shares": float(-(share[share > 0] * np.log(share[share > 0])).sum()),
        }
        self.out.write_text(json.dumps(result, indent=1) + "\n")
        print(json.dumps(result, indent=1))

    def choices(self, clip: Clip, rng: np.random.Generator) -> Choices:
        """Corners of some frames, looked for in the others."""
        chosen = np.unique(np.linspace(0, len(clip) - 1, min(len(clip), self.frames)).astype(int))
        pictures = {i: described(self.features, grey_of(clip.rgb[i])) for i in chosen}
        matrix = clip.camera.matrix.astype(np.float64)
        views = {i: View(matrix, (f := clip.frame(int(i))).cam_from_world, f.depth_m) for i in chosen}
        made: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        for a in chosen[::5]:
            uv_px = corners(pictures[a], np.ones(pictures[a].grey.shape, dtype=bool), cell_px=30, count=60)
            uv_px = rng.permutation(uv_px)[: self.corners]
            depth_m, flat = views[a].depth_at(uv_px)
            uv_px, point = uv_px[flat], views[a].lift(uv_px, depth_m)[flat]
            descriptor, patch = pictures[a].describe(uv_px)[:, None], pictures[a].patches(uv_px, PATCH_PX)[:, None]
            for b in chosen[chosen != a]:
                there, deep = views[b].project(point)
                inside = np.isfinite(there).all(axis=-1) & in_image(there, pictures[b].size)
                off = views[b].near_depth_at(np.where(inside[:, None], there, -1.0)) - deep
                seen = inside & (abs(off) < 0.02 + 0.03 * deep)
                behind = inside & (off < -0.15 - 0.05 * deep)
                likeness = Likeness.of(pictures[b], descriptor, patch)
                turn, far = rng.uniform(0, 2 * np.pi, len(point)), rng.choice([20.0, 30, 50, 100], len(point))
                beside = there + far[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
                somewhere = rng.uniform(0, pictures[b].size, there.shape)
                true = np.where(seen[:, None], there, np.inf)
                made.append(_choose(likeness, there + rng.normal(size=there.shape), true, seen, 1.0))
                made.append(_choose(likeness, beside, true, seen | behind, 1.0))
                made.append(_choose(likeness, somewhere, true, ~inside, 1.0))
                made.append(_choose(likeness, there, true, behind, OCCLUDED_TIMES))
        return Choices(*(np.concatenate(each) for each in zip(*made, strict=True)))


def _choose(
    likeness: Likeness,
    uv_px: Float[np.ndarray, "K 2"],
    true_px: Float[np.ndarray, "K 2"],
    which: np.ndarray,
    weight: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Follow some corners at given places: what these and the likest others look like, and which is right."""
    at = np.where(which[:, None] & np.isfinite(uv_px), uv_px, 0.0)
    which = which & in_image(at, likeness.picture.size)
    cells = likeness.elsewhere_px(at, RIVALS)
    terms = [likeness.terms(at[:, None]), likeness.terms(cells, CELL_REACH_PX)]
    best_px = np.concatenate([at[:, None], terms[1][0]], axis=1)
    both = np.stack([np.concatenate([each[i] for each in terms], axis=1) for i in (1, 2)], axis=-1)
    near = np.linalg.norm(best_px - true_px[:, None], axis=-1) < NEAR_PX
    right = np.where(near.any(axis=1), near.argmax(axis=1), RIVALS + 1)
    return both[which], right[which], np.full(int(which.sum()), weight)


def log_odds(parameters: Float[np.ndarray, "4"], choices: Choices) -> Float[np.ndarray, "N C1"]:
    """Of each place and of none."""
    value = choices.terms @ parameters[:2] + parameters[2]
    value[:, 1:] += parameters[3]
    return np.concatenate([value, np.zeros((len(value), 1))], axis=1)


def loss(parameters: Float[np.ndarray, "4"], choices: Choices) -> float:
    """Mean negative log-likelihood."""
    value = log_odds(parameters, choices)
    each = np.logaddexp.reduce(value, axis=1) - value[np.arange(len(value)), choices.right]
    return float((choices.weight * each).sum() / choices.weight.sum())


def fit(choices: list[Choices]) -> Float[np.ndarray, "4"]:
    """The parameters under which the right places are most probable."""
    both = Choices(*(np.concatenate([getattr(c, name) for c in choices]) for name in ("terms", "right", "weight")))
    return minimize(loss, np.zeros(4), args=(both,)).x


def count(choices: Choices) -> int:
    """How many there are."""
    return len(choices.right)


if __name__ == "__main__":
    tyro.cli(FitAppearance).main()
