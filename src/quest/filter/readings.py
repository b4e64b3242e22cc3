"""What the posterior of a query looks like in a frame: readings from which a loss is told (:mod:`quest.model.doubt`).

They say how sure the posterior is, how like the anchor its place looks as it is and by its newest view alone, from how
far another side it is seen, and how well the body is known that brings it there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import softmax

from quest.filter.appearance import Likeness
from quest.filter.landmarks import Landmarks
from quest.filter.noise import Noise
from quest.filter.patches import look, tiles
from quest.filter.queries import READINGS, Queries
from quest.filter.surfaces import depth_error
from quest.filter.view import View, move

_MOST_LOG_ODDS, _MOST_DEVIATIONS = 20.0, 10.0


@dataclass(frozen=True)
class Weighed:
    """Where each of K queries is most probable, among P places: with its own patch, or brought by B = P - 1 bodies."""

    at_px: Float[np.ndarray, "K 2"]
    place_px: Float[np.ndarray, "K P 2"]
    log_odds: Float[np.ndarray, "K P"]
    """Of each place, against its own patch."""
    rides: Bool[np.ndarray, " K"]
    body: Int[np.ndarray, " K"]
    """That brings it there; the world where it goes with its patch."""
    depth_m: Float[np.ndarray, " K"]
    """That is expected there."""
    looks: Float[np.ndarray, " K"]
    """Log-likelihood ratio of the appearance there."""
    covered: Float[np.ndarray, " K"]
    """How probable it is that something is in front."""
    elsewhere: Float[np.ndarray, " K"]
    """Log-likelihood ratio of all places elsewhere, against nowhere."""


def read(
    queries: Queries, weighed: Weighed, likeness: Likeness, landmarks: Landmarks, view: View, noise: Noise
) -> Float[np.ndarray, "K N"]:
    """By :data:`quest.filter.queries.READINGS`, of K queries in a frame; finite, 0 where one has no meaning."""
    found = (
        _of_posterior(queries, weighed)
        | _of_looks(queries, weighed, likeness)
        | _of_side(queries, weighed, landmarks, view)
        | _of_body(queries, weighed, landmarks)
    )
    error_m = depth_error(weighed.depth_m, noise)
    deviations = (view.near_depth_at(weighed.at_px) - weighed.depth_m) / error_m
    found["depth off"] = deviations.clip(-_MOST_DEVIATIONS, _MOST_DEVIATIONS)
    # What was found again may be where some body would have brought the place that was named.
    off_m = np.linalg.norm(queries.place - queries.named_place, axis=-1).min(axis=1)
    found["off named"] = np.where(queries.anew, 1 - np.exp(-((off_m / error_m) ** 2) / 2), 0.0)
    return np.nan_to_num(np.stack([found[name] for name in READINGS], axis=1).astype(np.float64))


def _of_posterior(queries: Queries, weighed: Weighed) -> dict[str, np.ndarray]:
    """How sure it is, and how far apart the places are that it thinks of."""
    log_odds = np.sort(weighed.log_odds, axis=1)
    share = softmax(weighed.log_odds, axis=1)
    apart2 = ((weighed.place_px - weighed.at_px[:, None]) ** 2).sum(axis=-1)
    each = np.arange(len(queries))
    return {
        "lost": queries.lost_log_odds,
        "seen": queries.seen_log_odds,
        "rival": queries.rival_log_odds,
        "unseen s": queries.unseen_s,
        "elsewhere": weighed.elsewhere.clip(-_MOST_LOG_ODDS, _MOST_LOG_ODDS),
        "covered": weighed.covered,
        "own variance": np.log(queries.own_variance),
        "own found": queries.own_found.astype(np.float64),
        "rides": weighed.rides.astype(np.float64),
        "rides on world": (weighed.rides & (weighed.body == 0)).astype(np.float64),
        "own apart": np.log1p(np.linalg.norm(queries.own_px - weighed.place_px[each, weighed.body + 1], axis=-1)),
        "spread": np.log1p(np.sqrt((share * apart2).sum(axis=1))),
        "margin": log_odds[:, -1] - log_odds[:, -2],
    }


def _of_looks(queries: Queries, weighed: Weighed, likeness: Likeness) -> dict[str, np.ndarray]:
    """How like its anchor, and how like its newest view, it looks there."""
    cosine, correlation, other = likeness.by_each_view(weighed.at_px)
    picture = likeness.picture
    own, here = (
        (look(tiles(picture, at_px)) * look(queries.anchor)).sum(axis=1) for at_px in (queries.own_px, weighed.at_px)
    )
    return {
        "looks": weighed.looks.clip(-_MOST_LOG_ODDS, _MOST_LOG_ODDS),
        "anchor cosine": cosine[:, 0],
        "newest cosine": cosine[:, 1],
        "anchor correlation": correlation[:, 0],
        "newest correlation": correlation[:, 1],
        "anchor elsewhere": other[:, 0] - cosine[:, 0],
        "tile of own patch": own,
        "tile": here,
    }


def _of_side(queries: Queries, weighed: Weighed, landmarks: Landmarks, view: View) -> dict[str, np.ndarray]:
    """From how far another side it is seen than when it was named: degrees, and the logarithm of the distance."""
    each, pose = np.arange(len(queries)), landmarks.pose[weighed.body]
    named, now = queries.camera[each, weighed.body], view.cam_from_world @ pose
    rest = queries.place[each, weighed.body]
    arms = [rest - _centre(camera) for camera in (named, now)]
    far = [np.linalg.norm(arm, axis=-1) for arm in arms]
    with np.errstate(divide="ignore", invalid="ignore"):
        turn = np.degrees(np.arccos(((arms[0] * arms[1]).sum(axis=-1) / (far[0] * far[1])).clip(-1, 1)))
        nearer = np.log(far[1] / far[0])
    upright = (named[:, 1, :3] * now[:, 1, :3]).sum(axis=-1)
    went = np.linalg.norm(move(pose, rest) - rest, axis=-1)
    return {
        "turn": turn,
        "distance": nearer,
        "roll": np.degrees(np.arccos(upright.clip(-1, 1))),
        "went": np.log1p(100 * np.nan_to_num(went)),
    }


def _of_body(queries: Queries, weighed: Weighed, landmarks: Landmarks) -> dict[str, np.ndarray]:
    """How well the body is known that brings it, and how nearly it moves on one joint."""
    bodies, body = landmarks.bodies, weighed.body
    spread = np.linalg.eigvalsh(bodies.moment[body])
    shift = np.trace(bodies.covariance[body, 3:6, 3:6], axis1=1, axis2=2)
    share = landmarks.share(queries.rest, landmarks.rest)
    return {
        "body seen s": bodies.seen_s[body],
        "body error": np.log(shift + 1e-9),
        "screw": np.log(spread[:, -1] + 1e-9),
        "off screw": spread[:, -2] / (spread[:, -1] + 1e-9),
        "share": share[np.arange(len(body)), body],
    }


def _centre(camera: Float[np.ndarray, "K 4 4"]) -> Float[np.ndarray, "K 3"]:
    """Of cameras, on the body from which their poses are told."""
    return -np.einsum("kji,kj->ki", camera[:, :3, :3], camera[:, :3, 3])
