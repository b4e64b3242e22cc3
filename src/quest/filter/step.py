"""The filter's state and its step: points, camera, bodies, then each query under all hypotheses.

A query *rides* on a body, the still world or one that moves against it, or it goes with its *own* patch. All are kept
until they part; then how probable the distance is, how like the anchor each place is, and the depth there weigh them.
A hypothesis below odds of 1 : 150 begins anew at the best one. Without depth nothing is known to ride, and the own
patch, guided by the camera's motion, is the answer.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from quest.filter.landmarks import CameraMotion, Landmarks, observe, sow
from quest.filter.noise import Noise
from quest.filter.patches import GRID_PX, look, patch_motion
from quest.filter.surfaces import depth_error, depth_ratio
from quest.filter.view import View, in_image, move, move_back

_SURE = float(np.log(150.0))
_GATE = 12.0
"""Squared distance in standard deviations beyond which the anchor's patch found something else (chi-square, 0.25 %)."""


@dataclass(frozen=True)
class Queries:
    """K queries, and B bodies that may carry them."""

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
    place: Float[np.ndarray, "K B 3"]
    """On each body, metres; NaN without depth."""
    log_odds: Float[np.ndarray, "K B"]
    """That each body carries it, against that it goes with its patch."""

    def __len__(self) -> int:
        return len(self.anchor_frame)

    @property
    def known(self) -> Bool[np.ndarray, " K"]:
        """Whether its place is."""
        return np.asarray(np.isfinite(self.place[:, 0]).all(axis=-1))

    @property
    def body(self) -> Int[np.ndarray, " K"]:
        """The most probable carrier."""
        return np.asarray(self.log_odds.argmax(axis=1))

    @property
    def rides(self) -> Bool[np.ndarray, " K"]:
        """Whether it is more probable that a body carries it than that it goes with its patch."""
        return (self.log_odds.max(axis=1) > 0) & self.known

    def point_world(self, pose: Float[np.ndarray, "B 4 4"]) -> Float[np.ndarray, "K 3"]:
        """Where each is on its most probable body."""
        body = self.body
        return move(pose[body], self.place[np.arange(len(body)), body])


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


def begin(grey: UInt8[np.ndarray, "H W"], view: View, stamp_s: float, noise: Noise) -> FilterState:
    """The state after the first frame, without queries."""
    nobody = Queries(
        anchor_frame=np.zeros(0, dtype=np.int64),
        anchor_px=np.zeros((0, 2)),
        anchor_look=look(grey, np.zeros((0, 2))),
        own_px=np.zeros((0, 2)),
        own_variance=np.zeros(0),
        own_depth=np.zeros(0),
        own_found=np.zeros(0, dtype=bool),
        place=np.zeros((0, 1, 3)),
        log_odds=np.zeros((0, 1)),
    )
    return FilterState(grey, view, stamp_s, sow(Landmarks.none(), grey, view, np.zeros((0, 2)), noise), nobody, ())


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
    dt_s = stamp_s - state.stamp_s
    landmarks, camera = observe(state.landmarks, state.grey, grey, state.view, depth_m, cam_from_world, dt_s, noise)
    view = View(state.view.matrix, camera.cam_from_world, depth_m)
    queries = _meet(state.queries, len(landmarks.pose))
    if len(queries):
        queries = _follow(replace(state, queries=queries), landmarks, grey, view, camera, dt_s, noise)
        queries = _weigh(queries, landmarks, grey, view, dt_s, noise)
    landmarks = sow(landmarks, grey, view, _at(queries, landmarks, view), noise)
    return replace(state, grey=grey, view=view, stamp_s=stamp_s, landmarks=landmarks, queries=queries)


def _at(queries: Queries, landmarks: Landmarks, view: View) -> Float[np.ndarray, "K 2"]:
    ride_px, _ = view.project(queries.point_world(landmarks.pose))
    rides = queries.rides & np.isfinite(ride_px).all(axis=-1)
    return np.where(rides[:, None], ride_px, queries.own_px)


def _meet(queries: Queries, bodies: int) -> Queries:
    """A body that begins to move was part of the world: what rested there may ride on it."""
    new = bodies - queries.place.shape[1]
    return replace(
        queries,
        place=np.concatenate([queries.place, np.repeat(queries.place[:, :1], new, axis=1)], axis=1),
        log_odds=np.concatenate([queries.log_odds, np.repeat(queries.log_odds[:, :1], new, axis=1)], axis=1),
    )


def ask(state: FilterState, uv_px: Float[np.ndarray, "K 2"], noise: Noise) -> FilterState:
    """Follow some pixels of the newest frame as well."""
    count = len(uv_px)
    depth_m = state.view.near_depth_at(uv_px)
    new = Queries(
        anchor_frame=np.full(count, len(state.anchors)),
        anchor_px=uv_px,
        anchor_look=look(state.grey, uv_px),
        own_px=uv_px,
        own_variance=np.full(count, 0.5),
        own_depth=depth_m,
        own_found=np.ones(count, dtype=bool),
        place=_place(state.landmarks, state.view.lift(uv_px, depth_m)),
        log_odds=np.zeros((count, len(state.landmarks.pose))),
    )
    both = {name: np.concatenate([value, getattr(new, name)]) for name, value in vars(state.queries).items()}
    landmarks = sow(state.landmarks, state.grey, state.view, uv_px, noise)
    return replace(state, landmarks=landmarks, queries=Queries(**both), anchors=(*state.anchors, state.grey))


def _place(landmarks: Landmarks, point_world: Float[np.ndarray, "K 3"]) -> Float[np.ndarray, "K B 3"]:
    """Places of the world on every body."""
    return move_back(landmarks.pose, np.repeat(point_world[:, None], len(landmarks.pose), axis=1))


def _follow(
    state: FilterState,
    landmarks: Landmarks,
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
    expected = _expect(queries, state, landmarks, view, camera)
    motion = patch_motion(state.grey, grey, queries.own_px, expected, _of_surface(queries, state.view, noise))
    depth_m = view.near_depth_at(queries.own_px + motion.step_px)
    # Nothing comes nearer at once: what does is in front of it.
    near_m = queries.own_depth - depth_m - noise.speed_m_s * dt_s
    found = np.isfinite(motion.variance) & ~(near_m > 3 * depth_error(queries.own_depth, noise))
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
    off = (depth_m - queries.own_depth[:, None]) / (noise.relief_m + depth_error(queries.own_depth, noise)[:, None])
    return np.where(np.isfinite(off), np.exp(-(off**2) / 2), 1.0)


def _expect(
    queries: Queries, state: FilterState, landmarks: Landmarks, view: View, camera: CameraMotion
) -> Float[np.ndarray, "K 2"]:
    """Where the patches are if they went on with their most probable body since the previous frame."""
    warped = cv2.perspectiveTransform(queries.own_px[None], camera.picture)[0]
    depth_m = state.view.near_depth_at(queries.own_px)
    body = np.where(queries.rides, queries.body, 0)
    before = np.concatenate([state.landmarks.pose, np.tile(np.eye(4), (len(landmarks.pose), 1, 1))])[body]
    rode, _ = view.project(move(landmarks.pose[body], move_back(before, state.view.lift(queries.own_px, depth_m))))
    return np.where(np.isfinite(rode), rode, warped)


def _weigh(
    queries: Queries, landmarks: Landmarks, grey: UInt8[np.ndarray, "H W"], view: View, dt_s: float, noise: Noise
) -> Queries:
    """Which hypotheses explain the frame; what is out of question begins anew at the best."""
    count, bodies = queries.log_odds.shape
    ride_world = move(landmarks.pose, queries.place)
    ride_px, ride_depth = (
        each.reshape(count, bodies, *each.shape[1:]) for each in view.project(ride_world.reshape(-1, 3))
    )
    possible = np.asarray(np.isfinite(ride_px).all(axis=-1))
    ride_px = np.where(possible[..., None], ride_px, queries.own_px[:, None])
    apart = ((queries.own_px[:, None] - ride_px) ** 2).sum(axis=-1)
    near = queries.own_variance[:, None] + noise.world_px**2
    far = near + noise.moved_px**2
    gain = apart / 2 * (1 / far - 1 / near) + np.log(far / near)
    alike = (look(grey, ride_px.reshape(-1, 2)).reshape(count, bodies, -1) * queries.anchor_look[:, None]).sum(axis=-1)
    own_alike = (look(grey, queries.own_px) * queries.anchor_look).sum(axis=1)
    gain += ((1 - own_alike[:, None]) ** 2 - (1 - alike) ** 2) / (2 * noise.likeness**2)
    gain = np.where(queries.own_found[:, None], gain, 0.0)
    measured = view.near_depth_at(ride_px.reshape(-1, 2)).reshape(count, bodies)
    gain += depth_ratio(measured - ride_depth, depth_error(ride_depth, noise), noise)
    gain += np.log(
        landmarks.share(ride_world[np.arange(count), queries.body]) + np.where(np.arange(bodies) > 0, 1e-3, 0.1)
    )
    # Evidence repeats itself from frame to frame: however long it lasts, it counts once.
    change = noise.rests_log_odds + gain - queries.log_odds
    log_odds = queries.log_odds + np.where(possible, change, 0.0) * min(dt_s / noise.correlated_s, 1.0)
    depth_m = view.near_depth_at(queries.own_px)
    best = np.arange(count), log_odds.argmax(axis=1)
    goes = (~queries.known | (log_odds[best] < -_SURE)) & np.isfinite(depth_m) & queries.own_found
    far_off = (log_odds[best] > _SURE) & (apart[best] > _GATE * near[:, 0])
    rides = possible[best] & (~queries.own_found | far_off)
    return replace(
        queries,
        own_px=np.where(rides[:, None], ride_px[best], queries.own_px),
        own_variance=np.where(rides, noise.world_px**2, queries.own_variance),
        own_depth=np.where(rides, ride_depth[best], queries.own_depth),
        place=np.where(goes[:, None, None], _place(landmarks, view.lift(queries.own_px, depth_m)), queries.place),
        log_odds=np.where(goes[:, None], 0.0, np.clip(log_odds, -_SURE, _SURE)),
    )


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
    ride = queries.point_world(state.landmarks.pose)
    ride_px, ride_depth = view.project(ride)
    rides = queries.rides & np.isfinite(ride_px).all(axis=-1)
    uv_px = np.where(rides[:, None], ride_px, queries.own_px)
    measured = view.near_depth_at(uv_px)
    point = np.where(rides[:, None], ride, view.lift(uv_px, measured))
    height, width = state.grey.shape
    hidden = rides & (measured < ride_depth - 3 * depth_error(ride_depth, noise))
    supported = queries.own_found | (rides & np.isfinite(measured))
    return Answer(uv_px, point, in_image(uv_px, (width, height)) & ~hidden & supported)
