"""Measure how well joints are told from tracks: simulated ones with known joints, recorded ones with known kinds.

    python benchmarks/joints.py --out benchmarks/results/joints/joints.json

Every simulated track is seen at 30 frames/s, stands still for up to a second, is opened within two to five seconds and
ends where it has turned by 30 degrees or slid by 10 cm; half of them rest once on their way. The result says how many
points that are, and how well an estimator without bias could know the axis at best (Cramer and Rao). A tenth or a fifth
of the points are outliers by 15 cm per coordinate, where the name says so. Every recorded track is judged whole, where
it moves that far; recorded tracks are not part of the project, and the result has none where they are missing.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from rich.console import Console
from scipy.spatial.transform import Rotation

from quest.evaluation.bootstrap import interval_over
from quest.evaluation.drift import clopper_pearson
from quest.evaluation.report import provenance, write_report
from quest.geometry.vectors import perpendicular
from quest.grounding import Joint, JointEstimator, JointKind, JointPrior, fit_joint

KIND_OF_FOLDER = {
    "drawer": JointKind.PRISMATIC,
    "cabinet": JointKind.REVOLUTE,
    "door": JointKind.REVOLUTE,
    "dishwasher": JointKind.REVOLUTE,
}
"""What a part of a folder's name says about its tracks; other folders are unlabelled."""

MOVING = (JointKind.PRISMATIC, JointKind.REVOLUTE)
FRAMES_PER_S = 30
TURN_RAD, SLIDE_M = np.radians(30), 0.1


@dataclass(frozen=True)
class SimulatedTrack:
    """A track with its truth.

    Attributes:
        point: true points.
        kind: true kind.
        axis: true axis.
        origin: true point of the axis nearest to the first point (revolute).
        q: true position.
    """

    point: np.ndarray
    kind: JointKind
    axis: np.ndarray
    origin: np.ndarray
    q: np.ndarray


@dataclass(frozen=True)
class Joints:
    """Share of right kinds, axis errors and time per fit."""

    tracks: int = 200
    """Simulated tracks per condition."""
    sigma_m: float = 0.002
    """Noise of a simulated point per coordinate."""
    seed: int = 0
    """Seed of the simulated tracks."""
    recorded: Path = Path("../shared/data/articulation-tracks")
    """Folder of recorded tracks, one a file: `x y z` in metres a line; names of folders tell the kind."""
    out: Path | None = None
    """Result file."""

    def run(self) -> int:
        """Judge every condition and write the result."""
        conditions: dict[str, Any] = {
            "fit, noise known": {},
            "fit, noise unknown": {"known": False},
            "fit, noise known, 10 % outliers": {"outliers": 0.1},
            "fit, noise known, 20 % outliers": {"outliers": 0.2},
            "on line": {"online": True},
            "on line, 10 % outliers": {"online": True, "outliers": 0.1},
            "fit, 40 mm autocorrelated noise": {"sigma_m": 0.04, "correlation": 0.9, "frames": 30},
            "fit, 40 mm autocorrelated noise, prior": {
                "sigma_m": 0.04, "correlation": 0.9, "frames": 30, "prior": True,
            },
        }  # fmt: skip
        result: dict[str, Any] = {"simulated": {k: self._simulated(**v) for k, v in conditions.items()}}
        result["recorded"] = self._recorded() if next(self.recorded.rglob("*.log"), None) else {}
        result |= {"tracks": self.tracks, "sigma_m": self.sigma_m, "seed": self.seed, "load": os.getloadavg()[0]}
        result |= provenance()
        Console().print_json(data=result)
        if self.out is not None:
            write_report(result, self.out)
        return 0

    def _recorded(self) -> dict[str, Any]:
        return {
            "noise unknown": recorded(self.recorded, None),
            "noise 2 mm": recorded(self.recorded, 0.002),
            "noise 5 mm": recorded(self.recorded, 0.005),
            "on line, noise 2 mm": recorded(self.recorded, 0.002, online=True),
        }

    def _simulated(
        self,
        *,
        known: bool = True,
        outliers: float = 0.0,
        online: bool = False,
        sigma_m: float | None = None,
        correlation: float = 0.0,
        frames: int | None = None,
        prior: bool = False,
    ) -> dict[str, Any]:
        sigma_m = self.sigma_m if sigma_m is None else sigma_m
        rng = np.random.default_rng(self.seed)
        tracks, joints, seconds, ratios = [], [], [], []
        for i in range(self.tracks):
            kind = MOVING[i % 2]
            far = (np.radians(60), 0.3) if frames else (TURN_RAD, SLIDE_M)
            track = simulate(rng, kind, far, frames=frames)
            seen = track.point + coloured(rng, track.point.shape, correlation) * sigma_m
            wrong = rng.random(len(seen)) < outliers
            seen[wrong] += rng.normal(0, 0.15, (int(wrong.sum()), 3))
            belief = believe(rng, track) if prior else None
            if online:
                joint, took = stream(seen, sigma_m)
                seconds += took
            else:
                start = time.process_time()
                joint = fit_joint(seen, sigma_m if known else None, prior=belief)
                seconds.append(time.process_time() - start)
            tracks.append(track)
            joints.append(joint)
            if joint.kind is not JointKind.STATIC:
                ratios.append(off_curve(joint, track))
        points = [len(track.point) for track in tracks]
        rows = summary(tracks, joints)
        if not correlation:
            best = np.array([best_possible(rng, track, sigma_m) for track in tracks])
            rows |= {"best_possible_axis_error_deg": {k: float(np.median(best[i::2])) for i, k in enumerate(MOVING)}}
        return rows | {
            "points": {"median": float(np.median(points)), "least": min(points), "most": max(points)},
            "cpu_ms_per_frame" if online else "cpu_ms_per_fit": {
                "median": 1e3 * float(np.median(seconds)),
                "mean": 1e3 * float(np.mean(seconds)),
                "p99": 1e3 * float(np.quantile(seconds, 0.99)),
            },
            "error_over_spread": {"median": float(np.median(ratios)), "p95": float(np.quantile(ratios, 0.95))},
        }


def simulate(
    rng: np.random.Generator, kind: JointKind, far: tuple[float, float], *, frames: int | None = None
) -> SimulatedTrack:
    """A handle that stands still, moves by minimum jerk, may rest on the way, and is seen until it went ``far``."""
    turn = Rotation.random(rng=rng).as_matrix()
    target = rng.uniform(np.radians(60), np.radians(120)) if kind is JointKind.REVOLUTE else rng.uniform(0.2, 0.5)
    still, moving = int(rng.integers(8, 30)), int(rng.uniform(2, 5) * FRAMES_PER_S)
    s = np.linspace(0, 1, moving)
    q = target * (10 * s**3 - 15 * s**4 + 6 * s**5)
    q = np.concatenate([np.zeros(still), q])
    if rng.random() < 0.5:
        place = int(rng.integers(still, len(q)))
        q = np.concatenate([q[:place], np.full(20, q[place]), q[place:]])
    q = q[: int(np.argmax(q >= min(far[kind is JointKind.PRISMATIC], target))) + 1]
    if frames is not None:
        q = q[np.linspace(0, len(q) - 1, frames).round().astype(int)]
    start = rng.uniform(-2, 2, 3)
    if kind is JointKind.PRISMATIC:
        return SimulatedTrack(start + q[:, None] * turn[2], kind, turn[2], start, q)
    radius = rng.uniform(0.1, 0.9)
    arm = np.cos(q)[:, None] * turn[0] + np.sin(q)[:, None] * turn[1]
    return SimulatedTrack(start + radius * arm, kind, turn[2], start, q)


def coloured(rng: np.random.Generator, shape: tuple[int, ...], correlation: float) -> np.ndarray:
    """Unit Gaussian noise, autoregressive over the first axis."""
    noise = rng.normal(size=shape)
    for t in range(1, shape[0]):
        noise[t] = correlation * noise[t - 1] + np.sqrt(1 - correlation**2) * noise[t]
    return noise


def believe(rng: np.random.Generator, track: SimulatedTrack) -> JointPrior:
    """What a fair network says: right in four of five kinds, off by ten degrees and five centimetres."""
    right = rng.random() < 0.8
    revolute = (track.kind is JointKind.REVOLUTE) == right
    about = {k: track.axis if track.kind is k else rng.normal(size=3) for k in JointKind}
    about = {k: v / np.linalg.norm(v) + rng.normal(0, np.radians(10), 3) for k, v in about.items()}
    origin = track.origin if track.kind is JointKind.REVOLUTE else track.point[0] + rng.normal(0, 0.4, 3)
    return JointPrior(
        revolute_probability=0.8 if revolute else 0.2,
        prismatic_axis=about[JointKind.PRISMATIC],
        prismatic_axis_sigma_rad=float(np.radians(10)),
        revolute_axis=about[JointKind.REVOLUTE],
        revolute_axis_sigma_rad=float(np.radians(10)),
        origin=origin + rng.normal(0, 0.05, 3),
        origin_sigma=0.05,
    )


def stream(points: np.ndarray, sigma_m: float) -> tuple[Joint, list[float]]:
    """The last joint of a stream, and the time of each frame."""
    estimator, joint, seconds = JointEstimator(sigma_m), None, []
    for point in points:
        start = time.process_time()
        estimator.add(point)
        joint = estimator.joint
        seconds.append(time.process_time() - start)
    assert joint is not None
    return joint, seconds


def off_curve(joint: Joint, track: SimulatedTrack) -> float:
    """How far the truth, gone half as far again as was seen, is from the joint's curve, over what the joint expects."""
    q = 1.5 * track.q[-1:]
    if track.kind is JointKind.PRISMATIC:
        point = track.point[0] + q[:, None] * track.axis
    else:
        point = track.origin + Rotation.from_rotvec(q[0] * track.axis).apply(track.point[:1] - track.origin)
    at = joint.locate(point)
    return float(np.linalg.norm(point - joint.at(at)) / (2**0.5 * joint.spread(at)[0]))


def summary(tracks: list[SimulatedTrack], joints: list[Joint]) -> dict[str, Any]:
    """Kinds and axes, each kind of joint apart and together; axes of tracks whose kind is right."""
    right = np.array([t.kind is j.kind for t, j in zip(tracks, joints, strict=True)])
    kind = np.array([t.kind for t in tracks])
    cosine = np.array([abs(t.axis @ j.axis) for t, j in zip(tracks, joints, strict=True)])
    angle = np.degrees(np.arccos(np.minimum(cosine, 1)))
    rows = {}
    for name, of in {"all": kind != "", "prismatic": kind == "prismatic", "revolute": kind == "revolute"}.items():
        rows[name] = {"kind_right": share(right[of]), "axis_error_deg": middle(angle[of & right])}
    return rows


def best_possible(rng: np.random.Generator, track: SimulatedTrack, sigma_m: float) -> np.ndarray:
    """Draws of the axis error in degrees at the Cramer-Rao bound, all points good and their noise independent."""
    basis = perpendicular(track.axis)
    if track.kind is JointKind.PRISMATIC:
        covariance = np.eye(2) / np.square(track.q - track.q.mean()).sum()
    else:
        outward = track.point - track.origin
        outward /= np.linalg.norm(outward, axis=1, keepdims=True)
        # Height above the circle's plane tells tilt and height; the distance to the axis tells nothing of the tilt.
        slope = np.column_stack(((track.point - track.origin) @ basis, np.ones(len(outward))))
        covariance = np.linalg.inv(slope.T @ slope)[:2, :2]
    draws = rng.multivariate_normal(np.zeros(2), covariance * sigma_m**2, size=100)
    return np.degrees(np.linalg.norm(draws, axis=1))


def share(right: np.ndarray) -> dict[str, Any]:
    """Share with its 95 % interval (Clopper and Pearson)."""
    if not len(right):
        return {"n": 0}
    low, high = clopper_pearson(int(right.sum()), len(right))
    return {"share": float(right.mean()), "low": low, "high": high, "n": len(right)}


def middle(value: np.ndarray) -> dict[str, Any]:
    """Median with its 95 % bootstrap interval."""
    if not len(value):
        return {"n": 0}
    low, high = interval_over(value, lambda drawn: np.median(drawn, axis=-1))
    p95 = float(np.quantile(value, 0.95))
    return {"median": float(np.median(value)), "low": low, "high": high, "p95": p95, "n": len(value)}


def recorded(folder: Path, sigma_m: float | None, *, online: bool = False) -> dict[str, Any]:
    """Kinds of the recorded tracks whose folders tell them, and which were taken for something else."""
    right, wrong, short = [], [], 0
    for path in sorted(folder.rglob("*.log")):
        kinds = {kind for word, kind in KIND_OF_FOLDER.items() if word in path.parent.name}
        if len(kinds) != 1:
            continue
        points = np.loadtxt(path)[:, :3]
        joint = stream(points, sigma_m)[0] if online and sigma_m else fit_joint(points, sigma_m)
        if not moves_far(points, joint):
            short += 1
            continue
        right.append(joint.kind in kinds)
        if not right[-1]:
            wrong.append(f"{path.parent.name}/{path.name}: {joint.kind}")
    return {"kind_right": share(np.array(right)), "wrong": wrong, "too_short": short}


def moves_far(points: np.ndarray, joint: Joint) -> bool:
    """Whether a track turns or slides far enough to be judged."""
    turned = joint.kind is JointKind.REVOLUTE and joint.upper - joint.lower >= TURN_RAD
    return bool(turned or np.linalg.norm(points - points[0], axis=1).max() >= SLIDE_M)


if __name__ == "__main__":
    raise SystemExit(tyro.cli(Joints).run())
