"""Whether the tracker still follows as it did, with the weights that ship: one run a clip and stride.

Against the truth, it must not become worse than the figures on file allow. Against the recorded answers, it must stay
the same but for the rounding of other machines: a change that is meant is recorded anew (``python -m tests.golden``).
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from tests.golden.streams import (
    CLIPS,
    Figures,
    GoldenClip,
    arrays_of,
    follow,
    judge,
    load,
    read_answers,
    read_figures,
)

pytestmark = pytest.mark.slow

MARGIN = 1.25
"""How much worse than on file a figure may become, and beside that, by its unit: """
MARGIN_PX, MARGIN_MM, MARGIN_DEG = 0.5, 3.0, 2.0

SAME_PX, SAME_M, SAME_P = 0.5, 0.005, 0.05
"""Median distance to the recorded answers: half a pixel, half a centimetre, a twentieth of a probability."""
SAME_AXIS_DEG = 2.0
SAME_FLAGS = 0.05
"""Share of frames in which visible or alarm may be another: those in which a probability is near its threshold."""
RUNS = [(clip, stride) for clip in CLIPS for stride in clip.strides]

tracker = cache(load)


def worse(got: Figures, was: Figures, truth: str) -> list[str]:
    """In which ways an answer is worse than it may be."""
    found = [
        f"{what} {value} > {allowed:.2f}"
        for what, value, allowed in (
            ("median_px", got.median_px, MARGIN * was.median_px + MARGIN_PX),
            ("median_mm", got.median_mm, MARGIN * was.median_mm + MARGIN_MM),
            ("end_mm", got.end_mm, MARGIN * was.end_mm + MARGIN_MM),
        )
        if not value <= allowed
    ]
    if was.identity and not got.identity:
        found.append("another entity is nearer at the end")
    if got.joint not in (was.joint, truth):
        found.append(f"joint {got.joint}, was {was.joint}")
    if was.axis_deg is not None and got.axis_deg is not None and got.axis_deg > MARGIN * was.axis_deg + MARGIN_DEG:
        found.append(f"axis {got.axis_deg} degrees off, was {was.axis_deg}")
    return found


def distance(got: np.ndarray, was: np.ndarray) -> np.ndarray:
    """Distance of values or points [T, K] or [T, K, D]: 0 where both are unknown, infinite where one is."""
    off = np.abs(got - was)
    off = np.linalg.norm(off, axis=-1) if off.ndim == 3 else off
    unknown = [np.isnan(values).reshape(*off.shape, -1).any(axis=-1) for values in (got, was)]
    return np.where(unknown[0] & unknown[1], 0.0, np.where(unknown[0] | unknown[1], np.inf, off))


def differences(got: dict[str, np.ndarray], was: dict[str, np.ndarray]) -> list[str]:
    """In which ways answers are others than those on file."""
    for name in ("name", "joint"):
        if got[name].tolist() != was[name].tolist():
            return [f"{name}: {got[name].tolist()}, recorded {was[name].tolist()}"]
    found = []
    for name, limit in (("uv_px", SAME_PX), ("point_world", SAME_M), ("confidence", SAME_P), ("lost_p", SAME_P)):
        off = np.median(distance(got[name], was[name]), axis=0)
        found += [f"{name} of {got['name'][k]}: median {off[k]:.4f} off" for k in np.flatnonzero(off > limit)]
    for name in ("visible", "alarm"):
        share = (got[name] != was[name]).mean(axis=0)
        found += [f"{name} of {got['name'][k]}: {share[k]:.0%} of frames" for k in np.flatnonzero(share > SAME_FLAGS)]
    cosine = np.abs((got["axis"] * was["axis"]).sum(axis=-1))
    turned = np.degrees(np.arccos(np.clip(cosine, 0, 1)))
    found += [f"axis of {got['name'][k]}: {turned[k]:.1f} degrees" for k in np.flatnonzero(turned > SAME_AXIS_DEG)]
    return found


@pytest.mark.parametrize(("clip", "stride"), RUNS, ids=[f"{clip.name}-{stride}" for clip, stride in RUNS])
def test_answers_are_as_good_as_they_were_and_the_same(clip: GoldenClip, stride: int):
    truth = clip.truth()
    tracks = follow(tracker(), clip.read(), clip.queries(truth), stride)
    got, was = judge(tracks, truth, stride), read_figures(clip, stride)
    assert got.keys() == was.keys()
    kinds = dict(zip(got, truth.joint[truth.followed(tracks)].tolist(), strict=True))
    assert {name: found for name in got if (found := worse(got[name], was[name], kinds[name]))} == {}
    apart = [differences(arrays_of(tracks), recorded) for recorded in read_answers(clip, stride)]
    assert [] in apart, apart


@pytest.mark.parametrize("clip", [clip for clip in CLIPS if clip.take is not None], ids=lambda clip: clip.name)
def test_an_entity_is_hidden_and_comes_again(clip: GoldenClip):
    truth = clip.truth()
    seen = truth.visible[:, truth.index(clip.entities[0])]
    assert seen[0]
    assert seen[-10:].all()
    assert (~seen).sum() >= 10


def test_a_tracker_that_becomes_worse_is_noticed():
    was = Figures(1.0, 5.0, 6.0, True, "revolute", 3.0)
    assert worse(was, was, "revolute") == []
    assert len(worse(Figures(2.0, 12.0, 30.0, False, "prismatic", None), was, "revolute")) == 5
    answers = read_answers(CLIPS[0], CLIPS[0].strides[0])[0]
    assert differences(answers, answers) == []
    assert len(differences({**answers, "uv_px": answers["uv_px"] + 1}, answers)) == len(answers["name"])
