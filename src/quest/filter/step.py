"""The filter's state and its step: points, camera, bodies, then each query under all hypotheses.

A query *rides* on a body, the still world or one that moves against it, or it goes with its *own* patch. All are kept
until they part (:mod:`quest.filter.posterior`); a hypothesis below odds of 1 : 150 begins anew at the best one.
Without depth nothing is known to ride, and the own patch, guided by the camera's motion, is the answer.

The filter counts in the pixels of its pictures, which may be larger than the camera's; what it is asked and what it
answers are pixels of the camera.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from quest.filter.appearance import CELL_REACH_PX, Likeness
from quest.filter.joints import Joint, joints_of
from quest.filter.landmarks import Landmarks, observe, ray_error, sow
from quest.filter.layers import Layers, observe_layers, sow_layers
from quest.filter.local_motion import follow
from quest.filter.noise import Noise
from quest.filter.picture import GreyPicture, Picture
from quest.filter.posterior import weigh
from quest.filter.queries import Queries, follow_patches
from quest.filter.surfaces import depth_error
from quest.filter.view import View, in_image, move, move_back


@dataclass(frozen=True)
class FilterState:
    """All that is known after a frame."""

    picture: Picture
    view: View
    stamp_s: float
    landmarks: Landmarks
    queries: Queries
    layers: Layers | None
    """What is known of pictures as long as none had depth."""
    warp: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    """Homography of the picture since the previous frame, for places without depth; in the picture's pixels."""


def begin(picture: Picture, view: View, stamp_s: float, noise: Noise) -> FilterState:
    """The state after the first frame, without queries."""
    nowhere = np.zeros((0, 2))
    layers = Layers.none(picture.size) if view.depth_m is None else None
    landmarks, layers = _sown(Landmarks.none(), layers, picture, view, nowhere, noise)
    place, error = np.zeros((0, 1, 3)), np.zeros((0, 3))
    queries = Queries.named(picture, nowhere, np.zeros(0), place, error, layers, view.cam_from_world[None])
    return FilterState(picture, view, stamp_s, landmarks, queries, layers)


def step(
    state: FilterState,
    grey: GreyPicture,
    describe: Callable[[], Float32[np.ndarray, "D h w"]],
    depth_m: Float[np.ndarray, "H W"] | None,
    stamp_s: float,
    cam_from_world: Float[np.ndarray, "4 4"] | None,
    noise: Noise,
) -> FilterState:
    """Take in the next frame; depth is 0 where missing and None without any, the pose None to estimate it.

    ``describe`` gives the descriptors of the picture. They are needed last, and may be made meanwhile.
    """
    dt_s = stamp_s - state.stamp_s
    landmarks, pose, warp = observe(
        state.landmarks, state.picture, grey, state.view, depth_m, cam_from_world, dt_s, noise
    )
    view, layers = View(state.view.matrix, pose, depth_m), None
    if state.layers is not None:
        seen = observe_layers(state.layers, state.picture, grey, dt_s, noise)
        warp = seen.world_since(state.layers)
        layers = seen if depth_m is None else None
    queries = state.queries.meet(len(landmarks.pose), layers)
    if len(queries):
        body = np.where(queries.rides, queries.body, 0)
        expected_px = _carried(queries.own_px, body, state, landmarks, view, warp)
        queries = follow_patches(queries, state.picture, grey, expected_px, state.view, view, dt_s, noise)
    picture = grey.described(describe())
    if len(queries):
        queries = weigh(queries, landmarks, layers, picture, view, dt_s, noise)
    landmarks, layers = _sown(landmarks, layers, picture, view, _at(queries, landmarks, view)[0], noise)
    return FilterState(picture, view, stamp_s, landmarks, queries, layers, warp)


def _sown(
    landmarks: Landmarks,
    layers: Layers | None,
    picture: Picture,
    view: View,
    around_px: Float[np.ndarray, "K 2"],
    noise: Noise,
) -> tuple[Landmarks, Layers | None]:
    """With new points where there are none; without depth so far they are those of layers."""
    if layers is None:
        return sow(landmarks, picture, view, around_px, noise), None
    return landmarks, sow_layers(layers, picture, around_px)


def _at(
    queries: Queries, landmarks: Landmarks, view: View
) -> tuple[Float[np.ndarray, "K 2"], Bool[np.ndarray, " K"], Float[np.ndarray, "K 3"], Float[np.ndarray, " K"]]:
    """Pixels of queries, which of them their bodies carry, and where those would be: world points and depths."""
    ride = queries.point_world(landmarks.pose)
    ride_px, ride_depth = view.project(ride)
    rides = queries.rides & np.isfinite(ride_px).all(axis=-1)
    return np.where(rides[:, None], ride_px, queries.own_px), rides, ride, ride_depth


def ask(state: FilterState, uv_px: Float[np.ndarray, "K 2"], noise: Noise) -> FilterState:
    """Follow some pixels of the newest frame as well."""
    uv_px = state.picture.from_camera(uv_px)
    depth_m, pose = state.view.near_depth_at(uv_px), state.landmarks.pose
    point = state.view.lift(uv_px, depth_m)
    place = move_back(pose, np.repeat(point[:, None], len(pose), axis=1))
    error = ray_error(state.view, uv_px, point, noise)
    camera = state.view.cam_from_world @ pose
    new = Queries.named(state.picture, uv_px, depth_m, place, error, state.layers, camera)
    landmarks, layers = _sown(state.landmarks, state.layers, state.picture, state.view, uv_px, noise)
    return replace(state, landmarks=landmarks, layers=layers, queries=state.queries.join(new))


def keep(state: FilterState, rows: Sequence[int]) -> FilterState:
    """Follow some of the queries alone."""
    return replace(state, queries=state.queries.only(np.array(rows, dtype=np.int64)))


def confirm(state: FilterState, row: int) -> FilterState:
    """One query is where it is followed, as somebody says who knows."""
    return replace(state, queries=state.queries.there(row))


def carry(
    old: FilterState, new: FilterState, warp: Float[np.ndarray, "3 3"], uv_px: Float[np.ndarray, "N 2"]
) -> Float[np.ndarray, "N 2"]:
    """Where pixels of an earlier frame are in a later one: where the body at each went, corrected by its patch.

    The homography from one picture to the other is the product of :attr:`FilterState.warp` in between.
    """
    if old is new or not len(uv_px):
        return uv_px
    uv_px = old.picture.from_camera(uv_px)
    expected_px = _carried(uv_px, _body_at(old, uv_px), old, new.landmarks, new.view, warp)
    return new.picture.to_camera(follow(old.picture, new.picture, uv_px, expected_px).uv_px)


def moves_alone(state: FilterState, uv_px: Float[np.ndarray, "N 2"]) -> Bool[np.ndarray, " N"]:
    """Whether pixels lie on a body that moved against the world and that no query rides on."""
    body = _body_at(state, state.picture.from_camera(uv_px))
    return (body > 0) & ~np.isin(body, state.queries.body[state.queries.rides])


def returns(state: FilterState, uv_px: Float[np.ndarray, "N 2"], noise: Noise) -> Bool[np.ndarray, " N"]:
    """Whether each pixel is more probably than not a query that is not seen where it is followed."""
    queries = state.queries.only(np.flatnonzero(state.queries.seen_log_odds <= 0))
    if not (len(queries) and len(uv_px)):
        return np.zeros(len(uv_px), dtype=bool)
    uv_px = state.picture.from_camera(uv_px)
    likeness = Likeness.of(state.picture, queries.descriptor, queries.patch)
    alike = likeness.at(np.repeat(uv_px[None], len(queries), axis=0), noise, CELL_REACH_PX).log_odds
    left = np.minimum(queries.lost_log_odds, 0)
    return np.asarray((alike + noise.jump_log_odds + left[:, None] > 0).any(axis=0))


def _body_at(state: FilterState, uv_px: Float[np.ndarray, "N 2"]) -> Int[np.ndarray, " N"]:
    """The body that carries most points around each pixel; the world without depth."""
    point = state.view.lift(uv_px, state.view.near_depth_at(uv_px))
    return np.asarray(state.landmarks.share(point, state.landmarks.point_world).argmax(axis=1))


def _carried(
    uv_px: Float[np.ndarray, "N 2"],
    body: Int[np.ndarray, " N"],
    old: FilterState,
    landmarks: Landmarks,
    view: View,
    warp: Float[np.ndarray, "3 3"],
) -> Float[np.ndarray, "N 2"]:
    """Where pixels of an earlier frame are if they went on with their bodies; without depth, with the picture."""
    warped = cv2.perspectiveTransform(uv_px[None], warp)[0]
    depth_m = old.view.near_depth_at(uv_px)
    before = np.concatenate([old.landmarks.pose, np.tile(np.eye(4), (len(landmarks.pose), 1, 1))])[body]
    rode, _ = view.project(move(landmarks.pose[body], move_back(before, old.view.lift(uv_px, depth_m))))
    return np.where(np.isfinite(rode), rode, warped)


@dataclass(frozen=True)
class Answer:
    """Where K queries are."""

    uv_px: Float[np.ndarray, "K 2"]
    """Pixels of the camera."""
    point_world: Float[np.ndarray, "K 3"]
    """Metres; NaN without depth."""
    visible: Bool[np.ndarray, " K"]
    lost_log_odds: Float[np.ndarray, " K"]
    """That it is not there."""
    readings: Float[np.ndarray, "K N"]
    """What tells whether it is lost (:data:`quest.filter.queries.READINGS`); NaN where nothing does."""
    joint: tuple[Joint | None, ...]
    """What moves it, in the filter's world; None where that is not known."""


def pixels(state: FilterState) -> Float[np.ndarray, "K 2"]:
    """The more probable place of every query, in pixels of the camera."""
    return state.picture.to_camera(_at(state.queries, state.landmarks, state.view)[0])


def read_off(state: FilterState, noise: Noise) -> Answer:
    """The more probable place of every query; seen unless out of view, not found, or behind something."""
    queries, view = state.queries, state.view
    uv_px, rides, ride, ride_depth = _at(queries, state.landmarks, view)
    measured, expected = view.near_depth_at(uv_px), np.where(rides, ride_depth, queries.own_depth)
    hidden = measured < expected - 3 * depth_error(expected, noise)
    own = view.lift(uv_px, np.where(hidden | np.isnan(measured), expected, measured))
    point = np.where(rides[:, None], ride, own)
    visible = in_image(uv_px, state.picture.size) & ~hidden & (queries.seen_log_odds > 0)
    seen_px = state.picture.to_camera(uv_px)
    joints = joints_of(queries, state.landmarks, noise)
    return Answer(seen_px, point, visible, queries.lost_log_odds, queries.readings, joints)
