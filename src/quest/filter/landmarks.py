"""Points all over the picture, and the bodies that carry them: the still world first, and what moves against it.

Each point keeps its place on every body since its birth, so that the bodies' poses are fitted from then to now. What
no body explains founds a new one, or is dropped; where points run out new ones are sown.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from quest.filter.bodies import Bodies, about, go_on, on_joint, update
from quest.filter.camera_motion import INLIER_PX, apart_px, estimate_pose, picture_motion, stands_still
from quest.filter.local_motion import corners, follow
from quest.filter.noise import Noise
from quest.filter.picture import GreyPicture
from quest.filter.rigid_motion import GATE, Seen, Surface, common_motion, fit, misfit_unsure, predicted_spread
from quest.filter.surfaces import Surfaces, depth_error, measure, sow_surfaces
from quest.filter.view import View, move, move_back

_CELL_PX = 20
_COUNT = 400
_FINE_PX = 5
_NEAR_PX = 18
_NEAR_COUNT = 25
MOST_BODIES = 16
SURE = float(np.log(150.0))
"""Log-odds beyond which a hypothesis is out of question."""
NEIGHBOURS = 5


@dataclass(frozen=True)
class Landmarks:
    """N points of the newest frame, and B bodies; body 0 is the world."""

    uv_px: Float[np.ndarray, "N 2"]
    covariance: Float[np.ndarray, "N 2 2"]
    """Pixels squared, gathered since birth."""
    place: Float[np.ndarray, "N B 3"]
    """On each body, metres; NaN without depth."""
    error: Float[np.ndarray, "N 3"]
    """Standard deviation of the place, along the ray of its birth, metres in the world."""
    log_weight: Float[np.ndarray, "N B"]
    """Log-odds of being carried by each body, against being on none of them."""
    surfaces: Surfaces
    bodies: Bodies
    world_px2: float = 0.0
    """Variance of where the world's points are seen in the newest frame with depth: poses and lenses err too."""

    @classmethod
    def none(cls) -> Landmarks:
        """Before the first frame."""
        return cls(
            np.zeros((0, 2)),
            np.zeros((0, 2, 2)),
            np.zeros((0, 1, 3)),
            np.zeros((0, 3)),
            np.zeros((0, 1)),
            Surfaces.none(),
            Bodies.world(),
        )

    @property
    def pose(self) -> Float[np.ndarray, "B 4 4"]:
        """``world_from_body``."""
        return self.bodies.pose

    def only(self, which: np.ndarray) -> Landmarks:
        """Some of the points, on all bodies."""
        own = ("uv_px", "covariance", "place", "error", "log_weight")
        return replace(self, **{name: getattr(self, name)[which] for name in own})

    @property
    def body(self) -> Int[np.ndarray, " N"]:
        """The most probable carrier of each point."""
        return np.asarray(self.log_weight.argmax(axis=1))

    @property
    def rests(self) -> Bool[np.ndarray, " N"]:
        """Whether each tells where the camera is."""
        return (self.body == 0) & (self.log_weight[:, 0] > -1) & np.isfinite(self.place[:, 0]).all(axis=-1)

    @property
    def point_world(self) -> Float[np.ndarray, "N 3"]:
        """Where each is, if its most probable body carries it."""
        return move(self.pose[self.body], self.rest)

    @property
    def rest(self) -> Float[np.ndarray, "N 3"]:
        """Where each was before its most probable body moved, metres."""
        return self.place[np.arange(len(self.body)), self.body]

    def ride_px2(
        self, place: Float[np.ndarray, "K B 3"], error: Float[np.ndarray, "K 3"], view: View
    ) -> Float[np.ndarray, "K B"]:
        """Variance of where each body brings some places, pixels squared.

        The error is a standard deviation of each place along the ray on which it was seen, metres in the world.
        """
        bodies, spread = self.bodies, []
        for b, pose in enumerate(bodies.pose):
            turned, covariance = error @ pose[:3, :3].T, bodies.covariance[b, :6, :6]
            spread.append(predicted_spread(move(pose, place[:, b]), bodies.middle[b], covariance, turned, view))
        return self.world_px2 + np.trace(np.stack(spread, axis=1)[..., :2, :2], axis1=-2, axis2=-1) / 2

    def share(self, point: Float[np.ndarray, "K 3"], around: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "K B"]:
        """Share of each body in the landmarks near some places, metres.

        The landmarks are ``around``: at :attr:`rest`, or at :attr:`point_world` for what is seen for the first time.
        """
        known = np.flatnonzero(np.isfinite(around).all(axis=-1))
        if len(known) <= NEIGHBOURS:
            return np.full((len(point), len(self.pose)), 1 / len(self.pose))
        asked = np.asarray(np.isfinite(point).all(axis=-1))
        total = members_near(np.where(asked[:, None], point, 0.0), around[known], self.log_weight[known])
        total = total * asked[:, None] + 1e-9
        return total / total.sum(axis=1, keepdims=True)


def observe(
    landmarks: Landmarks,
    previous: GreyPicture,
    picture: GreyPicture,
    old: View,
    depth_m: Float[np.ndarray, "H W"] | None,
    given: Float[np.ndarray, "4 4"] | None,
    dt_s: float,
    noise: Noise,
) -> tuple[Landmarks, Float[np.ndarray, "4 4"], Float[np.ndarray, "3 3"]]:
    """Follow landmarks into a frame some time after the previous one, and tell the motion of camera and bodies.

    Returns:
        The landmarks; the camera's pose, which is ``given`` where it is known; and the homography of the picture from
        the previous frame, for places without depth.
    """
    expected = old if given is None else replace(old, cam_from_world=given)
    landmarks = replace(landmarks, bodies=go_on(landmarks.bodies, dt_s, noise))
    guess, _ = expected.project(landmarks.point_world)
    guess = np.where(np.isfinite(guess), guess, landmarks.uv_px)
    motion = follow(previous, picture, landmarks.uv_px, guess)
    warp = picture_motion(landmarks.uv_px[motion.found], motion.uv_px[motion.found])
    covariance = landmarks.covariance + motion.covariance
    moved = replace(landmarks, uv_px=motion.uv_px, covariance=covariance).only(motion.found)
    pose = old.cam_from_world if given is None else given
    known = True
    if given is None and np.isfinite(moved.place).any():
        rests = moved.rests
        estimated = estimate_pose(moved.place[rests, 0], moved.uv_px[rests], old.matrix, pose)
        if estimated is None:
            return landmarks.only(np.zeros(len(covariance), dtype=bool)), pose, warp
        after = replace(old, cam_from_world=estimated[0])
        known = stands_still(moved.place[rests, 0], moved.uv_px[rests], old, after)
        if not known:
            pose = after.cam_from_world
            refuted = rests.copy()
            refuted[rests] = ~estimated[1]
            moved = moved.only(~refuted)
    view = estimated_view = View(old.matrix, pose, depth_m)
    if depth_m is not None:
        # What was sown without depth has no place; it is sown anew.
        moved = moved.only(np.flatnonzero(np.isfinite(moved.place[:, 0]).all(axis=-1)))
        if given is not None:
            # A given pose errs; what stands still as the picture tells it is no body that moves.
            rests = moved.rests
            place = moved.place[rests, 0]
            estimated = estimate_pose(place, moved.uv_px[rests], old.matrix, pose)
            estimated_view = view if estimated is None else replace(view, cam_from_world=estimated[0])
            known = estimated is None or apart_px(place, view, estimated_view) < INLIER_PX
        moved = _observe_bodies(moved, view, estimated_view, known, dt_s, noise)
    return moved, pose, warp


def _observe_bodies(
    landmarks: Landmarks, view: View, estimated_view: View, known: bool, dt_s: float, noise: Noise
) -> Landmarks:
    """The pose of each moving body, and which of them carries each point.

    The world is seen from ``view`` or, if that errs, from ``estimated_view``. Bodies begin where that is ``known``.
    """
    depth_m, error_m = layer_depth(view, landmarks.uv_px, noise)
    rests, _ = view.project(landmarks.place[landmarks.body == 0, 0])
    off = ((rests - landmarks.uv_px[landmarks.body == 0]) ** 2).sum(axis=-1)
    # The median of chi-square is ln 4.
    spread = max(noise.point_px**2, float(np.nanmedian(off)) / np.log(4)) if len(off) else noise.point_px**2
    landmarks = replace(landmarks, world_px2=spread)
    seen = Seen(landmarks.uv_px, depth_m, landmarks.covariance + spread * np.eye(2), error_m)
    told = (GATE - np.minimum(_misfits(landmarks, seen, view, estimated_view), 3 * GATE)) / 2
    told += np.log(landmarks.share(landmarks.point_world, landmarks.point_world) + noise.stray)
    weight = landmarks.log_weight + (told - landmarks.log_weight) * min(dt_s / noise.points_s, 1.0)
    body = np.where(told.max(axis=1) > 0, weight.argmax(axis=1), -1)
    near = landmarks.share(landmarks.surfaces.rest, landmarks.rest)
    surfaces = measure(landmarks.surfaces, landmarks.pose, near, view, dt_s, noise)
    bodies = landmarks.bodies
    for b in range(1, len(bodies)):
        bodies = _refit(bodies, b, landmarks.place[:, b], body == b, seen, surfaces, view, dt_s, noise)
    landmarks = replace(landmarks, bodies=bodies, surfaces=surfaces)
    off = _misfits(landmarks, seen, view, estimated_view)
    odd = (off.min(axis=1) > GATE) & np.isfinite(seen.depth_m)
    free = np.flatnonzero(odd & surrounded(landmarks.point_world, odd))
    new = None
    if known and len(bodies) < MOST_BODIES:
        new = common_motion(landmarks.place[free, 0], seen.only(free), view, noise)
    if new is not None:
        motion, inlier = new
        middle = move(motion, landmarks.place[free[inlier], 0]).mean(axis=0)
        joins = np.full(len(weight), -SURE)
        joins[free[inlier]] = SURE
        weight = np.concatenate([weight, joins[:, None]], axis=1)
        landmarks = replace(
            landmarks,
            bodies=bodies.with_one(motion, middle, noise),
            surfaces=surfaces.with_one(),
            place=np.concatenate([landmarks.place, landmarks.place[:, :1]], axis=1),
            log_weight=weight,
        )
    return replace(landmarks, log_weight=weight).only(weight.max(axis=1) > -SURE)


def members_near(
    point: Float[np.ndarray, "K D"], around: Float[np.ndarray, "N D"], log_weight: Float[np.ndarray, "N B"]
) -> Float[np.ndarray, "K B"]:
    """How many of the points near some places each body carries, the nearer ones the more; sure outliers count not."""
    apart, index = KDTree(around).query(point, NEIGHBOURS + 1)
    near = np.exp(-((apart / np.maximum(apart[:, -1:], 1e-9)) ** 2) / 2)
    member = np.eye(log_weight.shape[1])[log_weight.argmax(axis=1)] * (log_weight.max(axis=1) > -SURE)[:, None]
    return np.asarray(np.einsum("mn,mnb->mb", near, member[index]))


def surrounded(point: Float[np.ndarray, "N D"], odd: Bool[np.ndarray, " N"]) -> Bool[np.ndarray, " N"]:
    """Whether most points near each are odd as well: bodies are connected, and errors are scattered."""
    known = np.flatnonzero(np.isfinite(point).all(axis=-1))
    if len(known) <= NEIGHBOURS:
        return odd
    _, near = KDTree(point[known]).query(point[known], NEIGHBOURS + 1)
    most = np.zeros(len(point), dtype=bool)
    most[known] = odd[known][near].mean(axis=1) > 0.5
    return most


def _misfits(landmarks: Landmarks, seen: Seen, view: View, estimated_view: View) -> Float[np.ndarray, "N B"]:
    bodies = landmarks.bodies

    def off(b: int, view: View) -> Float[np.ndarray, " N"]:
        pose, covariance = bodies.pose[b], bodies.covariance[b, :6, :6]
        error = landmarks.error @ pose[:3, :3].T
        return misfit_unsure(move(pose, landmarks.place[:, b]), bodies.middle[b], covariance, error, seen, view)

    misfits = [off(b, view) for b in range(len(bodies))]
    if estimated_view is not view:
        misfits[0] = np.minimum(misfits[0], off(0, estimated_view))
    return np.stack(misfits, axis=1)


def _refit(
    bodies: Bodies,
    index: int,
    place: Float[np.ndarray, "N 3"],
    mine: Bool[np.ndarray, " N"],
    seen: Seen,
    surfaces: Surfaces,
    view: View,
    dt_s: float,
    noise: Noise,
) -> Bodies:
    covered = surfaces.body == index
    surface = Surface(surfaces.place[covered, index], surfaces.normal[covered, index])
    point = move(bodies.pose[index], np.concatenate([place[mine], surface.place]))
    if not len(point):
        return bodies
    bodies = about(bodies, index, point.mean(axis=0))
    middle = bodies.middle[index]
    known = np.linalg.inv(bodies.covariance[index][:6, :6])
    joint = on_joint(bodies, index, noise)
    pose, told = fit(place[mine], seen.only(mine), surface, view, bodies.pose[index], middle, known, joint, noise)
    return update(bodies, index, pose, told, dt_s, noise)


def sow(
    landmarks: Landmarks,
    picture: GreyPicture,
    view: View,
    around_px: Float[np.ndarray, "K 2"],
    noise: Noise,
) -> Landmarks:
    """Add corners where there are none, closer together around the queries; with depth only where there is any."""
    uv_px = new_corners(picture, landmarks.uv_px, around_px)
    landmarks = replace(landmarks, surfaces=sow_surfaces(landmarks.surfaces, landmarks.pose, view))
    return _born(landmarks, uv_px, view, noise)


def new_corners(
    picture: GreyPicture, uv_px: Float[np.ndarray, "N 2"], around_px: Float[np.ndarray, "K 2"]
) -> Float[np.ndarray, "M 2"]:
    """Corners of a picture where there are no points yet, closer together around some places."""
    near = np.zeros(picture.grey.shape, dtype=np.uint8)
    for x, y in around_px[np.isfinite(around_px).all(axis=-1)]:
        cv2.circle(near, (int(x), int(y)), _NEAR_PX, 1, -1)
    width, height = picture.size
    column, row = np.floor(uv_px).astype(np.int64).clip(0, (width - 1, height - 1)).T
    fine, all_over = _NEAR_COUNT * len(around_px) - int(near[row, column].sum()), _COUNT - len(uv_px)
    new = [np.zeros((0, 2))]
    for cell_px, allowed, count in ((_FINE_PX, near, fine), (_CELL_PX, np.ones_like(near), all_over)):
        for x, y in np.concatenate([uv_px, *new]):
            cv2.circle(allowed, (int(x), int(y)), cell_px, 0, -1)
        new.append(corners(picture, allowed > 0, cell_px=cell_px, count=count))
    return np.concatenate(new)


def layer_depth(
    view: View, uv_px: Float[np.ndarray, "N 2"], noise: Noise
) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """Depth and its error: at an edge of the nearer surface, to which the edge belongs, give or take the relief."""
    depth_m, flat = view.depth_at(uv_px)
    depth_m = np.where(flat, depth_m, view.near_depth_at(uv_px))
    return depth_m, np.where(flat, depth_error(depth_m, noise), noise.relief_m)


def ray_error(
    view: View, uv_px: Float[np.ndarray, "N 2"], point: Float[np.ndarray, "N 3"], noise: Noise
) -> Float[np.ndarray, "N 3"]:
    """Standard deviation of points that are seen at some pixels, along their rays, metres in the world."""
    return _along(view, point, layer_depth(view, uv_px, noise)[1])


def _along(view: View, point: Float[np.ndarray, "N 3"], error_m: Float[np.ndarray, " N"]) -> Float[np.ndarray, "N 3"]:
    ray = point - view.centre
    return ray / np.linalg.norm(ray, axis=-1, keepdims=True) * error_m[:, None]


def _born(landmarks: Landmarks, uv_px: Float[np.ndarray, "M 2"], view: View, noise: Noise) -> Landmarks:
    depth_m, error_m = layer_depth(view, uv_px, noise)
    if view.depth_m is not None:
        uv_px, depth_m, error_m = (each[np.isfinite(depth_m)] for each in (uv_px, depth_m, error_m))
    point = view.lift(uv_px, depth_m)
    error = _along(view, point, error_m)
    bodies = len(landmarks.pose)
    share = landmarks.share(point, landmarks.point_world)
    place = move_back(landmarks.pose, np.repeat(point[:, None], bodies, axis=1))
    return replace(
        landmarks,
        uv_px=np.concatenate([landmarks.uv_px, uv_px]),
        covariance=np.concatenate([landmarks.covariance, np.zeros((len(uv_px), 2, 2))]),
        place=np.concatenate([landmarks.place, place]),
        error=np.concatenate([landmarks.error, error]),
        log_weight=np.concatenate([landmarks.log_weight, np.log(np.maximum(share, 1e-2))]),
    )
