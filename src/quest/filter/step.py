"""The filter's state and its step: points, camera, then each query under two hypotheses.

A query *rests* in the world, where the camera's motion alone moves it in the picture, or it goes with its *own* patch.
Both are kept until they part; then how probable the distance is, and how like the anchor both places are, weigh them.
A hypothesis below odds of 1 : 150 begins anew at the other one. Without depth nothing is known to rest, and the own
patch, guided by the camera's motion, is the answer.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from quest.filter.landmarks import CameraMotion, Landmarks, observe_camera, sow
from quest.filter.noise import Noise
from quest.filter.patches import GRID_PX, look, patch_motion
from quest.filter.view import View, in_image

_SURE = float(np.log(150.0))
_GATE = 12.0
"""Squared distance in standard deviations beyond which the anchor's patch found something else (chi-square, 0.25 %)."""


def _known(places: Float[np.ndarray, "K D"]) -> Bool[np.ndarray, " K"]:
    return np.asarray(np.isfinite(places).all(axis=-1))


@dataclass(frozen=True)
class Queries:
    """K queries."""

    anchor_frame: Int[np.ndarray, " K"]
    """Index of the frame in which each was named, in :attr:`FilterState.anchors`."""
    anchor_px: Float[np.ndarray, "K 2"]
    anchor_look: Float[np.ndarray, "K S"]
    """Grey values around it, of mean 0 and length 1."""
    own_px: Float[np.ndarray, "K 2"]
    """Where its own patch went."""
    own_variance: Float[np.ndarray, " K"]
    """Pixels squared."""
    own_depth: Float[np.ndarray, " K"]
    """Its depth when it was seen last, metres; NaN if it never was."""
    own_found: Bool[np.ndarray, " K"]
    """Whether that patch was found in this frame, with nothing in front of it."""
    rest_world: Float[np.ndarray, "K 3"]
    """Where it is if it rests, metres; NaN without depth."""
    log_odds: Float[np.ndarray, " K"]
    """That it rests, against that it goes with its patch."""

    def __len__(self) -> int:
        return len(self.anchor_frame)

    @property
    def rests(self) -> Bool[np.ndarray, " K"]:
        """Whether it is more probable that it rests."""
        return (self.log_odds > 0) & _known(self.rest_world)


@dataclass(frozen=True)
class FilterState:
    """All that is known after a frame."""

    grey: UInt8[np.ndarray, "H W"]
    view: View
    stamp_s: float
    landmarks: Landmarks
    queries: Queries
    anchors: tuple[UInt8[np.ndarray, "H W"], ...]
    """Grey values of the frames in which queries were named."""


def begin(grey: UInt8[np.ndarray, "H W"], view: View, stamp_s: float) -> FilterState:
    """The state after the first frame, without queries."""
    nobody = Queries(
        anchor_frame=np.zeros(0, dtype=np.int64),
        anchor_px=np.zeros((0, 2)),
        anchor_look=look(grey, np.zeros((0, 2))),
        own_px=np.zeros((0, 2)),
        own_variance=np.zeros(0),
        own_depth=np.zeros(0),
        own_found=np.zeros(0, dtype=bool),
        rest_world=np.zeros((0, 3)),
        log_odds=np.zeros(0),
    )
    return FilterState(grey, view, stamp_s, sow(Landmarks.none(), grey, view), nobody, ())


def step(
    state: FilterState,
    grey: UInt8[np.ndarray, "H W"],
    depth_m: Float[np.ndarray, "H W"] | None,
    stamp_s: float,
    cam_from_world: Float[np.ndarray, "4 4"] | None,
    noise: Noise,
) -> FilterState:
    """Take in a frame.

    Args:
        state: after the previous one.
        grey: grey values.
        depth_m: metres, 0 where missing; None without depth.
        stamp_s: time, seconds.
        cam_from_world: the camera's pose; None to estimate it.
        noise: parameters.
    """
    landmarks, camera = observe_camera(state.landmarks, state.grey, grey, state.view, cam_from_world)
    view = View(state.view.matrix, camera.cam_from_world, depth_m)
    queries = state.queries
    if len(queries):
        queries = _follow(state, grey, view, camera, stamp_s - state.stamp_s, noise)
        queries = _weigh(queries, grey, view, stamp_s - state.stamp_s, noise)
    return replace(state, grey=grey, view=view, stamp_s=stamp_s, landmarks=sow(landmarks, grey, view), queries=queries)


def ask(state: FilterState, uv_px: Float[np.ndarray, "K 2"]) -> FilterState:
    """Follow some pixels of the newest frame as well."""
    count = len(uv_px)
    depth_m, _ = state.view.depth_at(uv_px)
    new = Queries(
        anchor_frame=np.full(count, len(state.anchors)),
        anchor_px=uv_px,
        anchor_look=look(state.grey, uv_px),
        own_px=uv_px,
        own_variance=np.full(count, 0.5),
        own_depth=depth_m,
        own_found=np.ones(count, dtype=bool),
        rest_world=state.view.lift(uv_px, depth_m),
        log_odds=np.zeros(count),
    )
    both = {name: np.concatenate([value, getattr(new, name)]) for name, value in vars(state.queries).items()}
    return replace(state, queries=Queries(**both), anchors=(*state.anchors, state.grey))


def _follow(
    state: FilterState,
    grey: UInt8[np.ndarray, "H W"],
    view: View,
    camera: CameraMotion,
    dt_s: float,
    noise: Noise,
) -> Queries:
    """Where each query's own patch went: its motion since the previous frame, then the anchor's patch around there.

    A Kalman filter: what is followed from frame to frame gathers variance, what the anchor finds takes it away.
    """
    queries = state.queries
    expected = _expect(queries, state.view, view, camera)
    motion = patch_motion(state.grey, grey, queries.own_px, expected, _of_surface(queries, state.view, noise))
    depth_m, _ = view.depth_at(queries.own_px + motion.step_px)
    # Nothing comes nearer at once: what does is in front of it.
    near_m = queries.own_depth - depth_m - noise.speed_m_s * dt_s
    found = np.isfinite(motion.variance) & ~(near_m > 3 * _depth_error(queries.own_depth, noise))
    own_px = np.where(found[:, None], queries.own_px + motion.step_px, expected)
    gathered = np.where(found, np.where(found, motion.variance, 0) + noise.chain_px2_s * dt_s, noise.blind_px2_s * dt_s)
    variance = queries.own_variance + gathered
    at_px, seen = own_px.copy(), np.zeros(len(queries), dtype=bool)
    for frame in np.unique(queries.anchor_frame):
        k = np.flatnonzero(queries.anchor_frame == frame)
        anchored = patch_motion(state.anchors[frame], grey, queries.anchor_px[k], own_px[k])
        at_px[k] = queries.anchor_px[k] + anchored.step_px
        seen[k] = np.isfinite(anchored.variance)
    total = variance + noise.anchor_px**2
    alike = (look(grey, at_px) * queries.anchor_look).sum(axis=1)
    seen &= found & (alike > noise.like_anchor) & (((at_px - own_px) ** 2).sum(axis=-1) < _GATE * total)
    gain = np.where(seen, variance / total, 0.0)
    return replace(
        queries,
        own_px=own_px + gain[:, None] * (at_px - own_px),
        own_variance=(1 - gain) * variance,
        own_depth=np.where(found & np.isfinite(depth_m), depth_m, queries.own_depth),
        own_found=found,
    )


def _of_surface(queries: Queries, view: View, noise: Noise) -> Float[np.ndarray, "K P"]:
    """How far the points of each patch are on the surface that is followed: as deep as it, or of unknown depth."""
    grid = (queries.own_px[:, None] + GRID_PX).reshape(-1, 2)
    depth_m = view.depth_at(grid)[0].reshape(len(queries), -1)
    off = (depth_m - queries.own_depth[:, None]) / (noise.relief_m + _depth_error(queries.own_depth, noise)[:, None])
    return np.where(np.isfinite(off), np.exp(-(off**2) / 2), 1.0)


def _depth_error(depth_m: Float[np.ndarray, " K"], noise: Noise) -> Float[np.ndarray, " K"]:
    return np.maximum(noise.depth_m, noise.depth * depth_m)


def _expect(queries: Queries, old: View, view: View, camera: CameraMotion) -> Float[np.ndarray, "K 2"]:
    """Where the patches are if they rested since the previous frame."""
    warped = cv2.perspectiveTransform(queries.own_px[None], camera.picture)[0]
    depth_m, _ = old.depth_at(queries.own_px)
    rested, _ = view.project(old.lift(queries.own_px, depth_m))
    return np.where(np.isfinite(rested), rested, warped)


def _weigh(queries: Queries, grey: UInt8[np.ndarray, "H W"], view: View, dt_s: float, noise: Noise) -> Queries:
    """Which of both hypotheses explains the frame; one that is out of question begins anew at the other."""
    rest_px, rest_depth = view.project(queries.rest_world)
    possible = _known(rest_px)
    rest_px = np.where(possible[:, None], rest_px, queries.own_px)
    apart = ((queries.own_px - rest_px) ** 2).sum(axis=-1)
    near = queries.own_variance + noise.world_px**2
    far = near + noise.moved_px**2
    gain = apart / 2 * (1 / far - 1 / near) + np.log(far / near)
    short = [1 - (look(grey, at) * queries.anchor_look).sum(axis=1) for at in (rest_px, queries.own_px)]
    gain += (short[1] ** 2 - short[0] ** 2) / (2 * noise.likeness**2)
    gain += _depth_there(view.depth_at(rest_px)[0], rest_depth, noise)
    told = possible & queries.own_found
    # Evidence repeats itself from frame to frame: however long it lasts, it counts once.
    change = noise.rests_log_odds + gain - queries.log_odds
    log_odds = queries.log_odds + np.where(told, change, 0.0) * min(dt_s / noise.correlated_s, 1.0)
    depth_m, _ = view.depth_at(queries.own_px)
    unknown = ~_known(queries.rest_world)
    goes = (unknown | (log_odds < -_SURE)) & np.isfinite(depth_m)
    rests = possible & (~queries.own_found | ((log_odds > _SURE) & (apart > _GATE * near)))
    return replace(
        queries,
        own_px=np.where(rests[:, None], rest_px, queries.own_px),
        own_variance=np.where(rests, noise.world_px**2, queries.own_variance),
        rest_world=np.where(goes[:, None], view.lift(queries.own_px, depth_m), queries.rest_world),
        log_odds=np.where(goes, 0.0, np.clip(log_odds, -_SURE, _SURE)),
    )


def _depth_there(
    measured_m: Float[np.ndarray, " K"], expected_m: Float[np.ndarray, " K"], noise: Noise
) -> Float[np.ndarray, " K"]:
    """Log-likelihood ratio of the depth at a place where something rests, against any depth; 0 behind an occluder."""
    spread = _depth_error(expected_m, noise)
    off = (measured_m - expected_m) / spread
    agrees = (1 - noise.stray) * np.exp(-(off**2) / 2) / (np.sqrt(2 * np.pi) * spread) + noise.stray / noise.depths_m
    told = np.isfinite(off) & (off > -3)
    return np.where(told, np.log(np.where(told, agrees, 1.0) * noise.depths_m), 0.0)


@dataclass(frozen=True)
class Answer:
    """Where K queries are."""

    uv_px: Float[np.ndarray, "K 2"]
    point_world: Float[np.ndarray, "K 3"]
    """Metres; NaN without depth."""
    visible: Bool[np.ndarray, " K"]


def read_off(state: FilterState, noise: Noise) -> Answer:
    """The more probable place of every query; seen unless out of view, not found, or behind something."""
    queries, view = state.queries, state.view
    rest_px, rest_depth = view.project(queries.rest_world)
    uv_px = np.where(queries.rests[:, None], rest_px, queries.own_px)
    measured, _ = view.depth_at(uv_px)
    point = np.where(queries.rests[:, None], queries.rest_world, view.lift(uv_px, measured))
    height, width = state.grey.shape
    hidden = queries.rests & (measured < rest_depth - 3 * _depth_error(rest_depth, noise))
    supported = queries.own_found | (queries.rests & np.isfinite(measured))
    return Answer(uv_px, point, in_image(uv_px, (width, height)) & ~hidden & supported)
