"""Verify stored takes: hashes, and whether the arrays of a take agree with each other.

Each check recomputes one thing from the others. Nothing but what is stored goes in, nothing is rendered again: a check
finds what went wrong between the simulator and the disk, and what an edited or foreign take contradicts itself in.
Limits leave room for single precision and for depth in steps of 0.1 mm.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from quest.data.store import TakeStore
from quest.data.take_format import DEPTH_SCALE_M, TAKE_ARRAYS, TakeHash, TakeHeader, take_arrays
from quest.errors import QuestError
from quest.types import Joint, Take, TakeInfo, View

REPROJECTION_PX = 0.5
RIGID = 1e-4
"""How far an entity may wander in its link, normalised units: 0.1 mm where half the diagonal is one metre."""
ON_JOINT = 1e-3
"""How far a link may be from where its joint says, normalised units."""
FLOW_M = 1e-5
VELOCITY = 0.25
"""How far velocities may be outside what the neighbouring positions span, as a share of the joint's highest speed."""
VISIBLE_WITHIN = 0.02
"""An entity is seen where depth is this close to its own, normalised units."""
INCONSISTENT_SHARE = 0.005
ORTHONORMAL = 1e-4

_FLOAT_M = 2e-6
"""What single precision does to coordinates of a few metres."""
_SLOWEST_FRAMES_PER_S = 10.0
_SENSOR_M, _SENSOR_PER_M = 0.01, 0.015
_SENSOR_REACH_PX = 2


@dataclass(frozen=True)
class Check:
    """What one check found."""

    name: str
    """Such as ``reprojection``."""
    passed: bool
    """Whether the worst value keeps the limit."""
    worst: float
    """The worst value."""
    limit: float
    """Up to where it is fine."""
    unit: str
    """Of both; empty for counts."""
    where: str
    """Where the worst value is, or what was skipped."""

    def __str__(self) -> str:
        place = f" ({self.where})" if self.where else ""
        unit = f" {self.unit}" if self.unit else ""
        return f"{self.name} {self.worst:.4g}{unit}, at most {self.limit:.4g}{unit}{place}"


def check_truth(take: Take) -> Iterator[Check]:
    """Checks of what is true of the whole take; needs no views."""
    bad = _bad_indices(take)
    yield _check("indices", len(bad), where="; ".join(bad))
    broken = {name: int((~np.isfinite(getattr(take, name))).sum()) for name in TAKE_ARRAYS}
    yield _check("finite", sum(broken.values()), where=", ".join(name for name, n in broken.items() if n))
    backwards = np.flatnonzero(np.diff(take.stamp_s) <= 0)
    yield _check("stamps", len(backwards), where="" if not len(backwards) else f"after frame {backwards[0]}")
    if bad or sum(broken.values()) or len(backwards):
        return  # the others cannot be computed
    yield _check_rotations("link poses", take.link_pose.reshape(-1, 4, 4), len(take))
    in_links = _in_links(take)
    moved_m = np.linalg.norm(in_links - in_links[:1], axis=-1)
    limit = RIGID * take.info.half_diagonal_m + _FLOAT_M
    yield _check("rigid in link", moved_m.max(initial=0), limit, "m", _place(take, moved_m))
    yield _check_joints(take, in_links[0])
    flow = np.zeros_like(take.point_world, dtype=np.float64)
    flow[:-1] = np.diff(take.point_world.astype(np.float64), axis=0)
    error_m = np.linalg.norm(flow - take.flow_world, axis=-1)
    yield _check("flow", error_m.max(initial=0), FLOW_M, "m", _place(take, error_m))
    yield _check_velocity(take)


def check_view(take: Take, view: View, number: int) -> Iterator[Check]:
    """Checks of one view, by its number, against a take that has passed the checks of indices and finite numbers."""
    where, pose, camera = f"view {number}", view.clip.cam_from_world, view.clip.camera
    yield _check_rotations("camera poses", pose, len(take), f"{where}, ")
    point = moved_points(pose, take.point_world.astype(np.float64))
    z = np.where(point[..., 2] > 1e-6, point[..., 2], np.nan)
    uv_px = np.stack((camera.fx * point[..., 0] / z + camera.cx, camera.fy * point[..., 1] / z + camera.cy), axis=-1)
    error_px = np.linalg.norm(uv_px - view.uv_px, axis=-1)
    # Far outside the image a pixel is an angle: the plane of the image reaches to infinity there.
    away_px = np.linalg.norm(uv_px - [camera.width / 2, camera.height / 2], axis=-1)
    error_px = error_px / np.fmax(1, away_px / (camera.width + camera.height))
    behind = np.isnan(uv_px).any(axis=-1)
    error_px = np.where(behind & np.isnan(view.uv_px).any(axis=-1), 0, np.nan_to_num(error_px, nan=np.inf))
    place = f"{where}, {_place(take, error_px)}"
    yield _check("reprojection", error_px.max(initial=0), REPROJECTION_PX, "px", place)
    wrong = _contradictions(take, view, point[..., 2])
    place = where + (f", first {_place(take, wrong)}" if wrong.any() else "")
    yield _check("visibility", 100 * wrong.mean() if wrong.size else 0, 100 * INCONSISTENT_SHARE, "%", place)
    # Pixels of an entity that are not of its link; and pixels of links or entities that there are not.
    links = np.full(256, -1, np.int16)
    links[: 1 + len(take.info.entities)] = [0, *(1 + e.link for e in take.info.entities)]
    marked = view.entity_id > 0
    strays = int((links[view.entity_id[marked]] != view.link_id[marked]).sum())
    strays += int((view.link_id > take.link_pose.shape[1]).sum())
    yield _check("masks", strays, where=where + ", pixels that belong to another link" * (strays > 0))


def has_sensed_depth(info: TakeInfo) -> bool:
    """Whether a take's depth went through the model of a depth sensor: noise, steps, holes."""
    sensor = info.provenance.get("sensor")
    return bool(sensor.get("depth")) if isinstance(sensor, Mapping) else bool(sensor)


def _bad_indices(take: Take) -> list[str]:
    links, joints = take.link_pose.shape[1], take.joint_position.shape[1]
    bad = [f"{e.name} is on link {e.link} of {links}" for e in take.info.entities if not 0 <= e.link < links]
    bad += [f"{e.name} is moved by joint {e.joint} of {joints}" for e in take.info.entities if not e.joint < joints]
    return bad + [f"moved joint {j} of {joints}" for j in take.info.moved_joints if not 0 <= j < joints]


def _check(name: str, worst: float, limit: float = 0.0, unit: str = "", where: str = "") -> Check:
    return Check(name, bool(worst <= limit), float(worst), limit, unit, where)


def moved_points(pose: Float[np.ndarray, "T 4 4"], point: Float[np.ndarray, "T N 3"]) -> Float[np.ndarray, "T N 3"]:
    """Points of every frame in other axes, by its pose."""
    return np.einsum("tij,tnj->tni", pose[:, :3, :3], point) + pose[:, None, :3, 3]


def _check_rotations(name: str, pose: Float[np.ndarray, "N 4 4"], frames: int, place: str = "") -> Check:
    """Whether poses are rigid: orthonormal, not mirrored, last row 0 0 0 1."""
    rotation = pose[:, :3, :3].astype(np.float64)
    error = np.abs(rotation @ rotation.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2), initial=0)
    error = np.maximum(error, np.abs(pose[:, 3] - [0, 0, 0, 1]).max(axis=1, initial=0))
    error = np.where(np.linalg.det(rotation) > 0, error, np.inf)
    worst = int(error.argmax()) if len(error) else 0
    where = f"{place}frame {worst // max(1, len(pose) // frames)}"
    return _check(name, error.max(initial=0), ORTHONORMAL, "", where)


def _in_links(take: Take) -> Float[np.ndarray, "T E 3"]:
    """Entities in the frames of their links."""
    pose = take.link_pose[:, [e.link for e in take.info.entities]].astype(np.float64)
    return np.einsum("teji,tej->tei", pose[..., :3, :3], take.point_world - pose[..., :3, 3])


def _check_joints(take: Take, in_links: Float[np.ndarray, "E 3"]) -> Check:
    """Every link moves about or along its joint's axis by what the joint's position changes.

    Which link a joint carries is known from its entities; joints without any are skipped.
    """
    limit = ON_JOINT * take.info.half_diagonal_m + _FLOAT_M
    worst, where = 0.0, "no entity on a joint"
    for link, j in sorted({(e.link, e.joint) for e in take.info.entities if e.joint >= 0}):
        on_link = [i for i, e in enumerate(take.info.entities) if e.link == link]
        steps = np.concatenate([np.zeros((1, 3)), take.info.half_diagonal_m * np.eye(3)])
        probes = (in_links[on_link][:, None] + steps).reshape(-1, 3)
        # The parent is not stored: it is one in which the axis stays where it is, most often one that never moves.
        parents = [None, *(p for p in range(take.link_pose.shape[1]) if p != link)]
        errors = []
        for parent in parents:
            errors.append(_joint_error(take, j, link, parent, probes))
            if errors[-1].max() <= limit:
                break
        error = min(errors, key=lambda e: e.max())
        if error.max() >= worst:
            worst, where = float(error.max()), f"frame {error.argmax()}, joint {j} ({take.info.joints[j].name})"
    return _check("moves on joint", worst, limit, "m", where)


def _joint_error(
    take: Take, j: int, link: int, parent: int | None, probes: Float[np.ndarray, "P 3"]
) -> Float[np.ndarray, " T"]:
    """How far a link is from where its joint puts it, if the joint sat on ``parent``; metres."""
    joint: Joint = take.info.joints[j]
    pose, axis = take.link_pose.astype(np.float64), take.joint_axis[:, j].astype(np.float64)
    base = np.tile(np.eye(4), (len(take), 1, 1)) if parent is None else pose[:, parent]
    into = base[:, :3, :3].swapaxes(1, 2)
    origin = np.einsum("tij,tj->ti", into, axis[:, :3] - base[:, :3, 3])
    direction = np.einsum("tij,tj->ti", into, axis[:, 3:])
    world = np.einsum("tij,pj->tpi", pose[:, link, :3, :3], probes) + pose[:, link, None, :3, 3]
    found = np.einsum("tij,tpj->tpi", into, world - base[:, None, :3, 3])
    by = take.joint_position[:, j].astype(np.float64) - float(take.joint_position[0, j])
    strays = take.info.half_diagonal_m * np.linalg.norm(direction - direction[0], axis=-1)
    if joint.kind == "prismatic":
        expected = found[0] + (by[:, None] * direction[0])[:, None]
    else:
        turn = Rotation.from_rotvec(by[:, None] * direction[0]).as_matrix()
        expected = np.einsum("tij,pj->tpi", turn, found[0] - origin[0]) + origin[0]
        off = origin - origin[0]
        strays += np.linalg.norm(off - (off @ direction[0])[:, None] * direction[0], axis=-1)
    return np.maximum(np.linalg.norm(expected - found, axis=-1).max(axis=-1), strays)


def _check_velocity(take: Take) -> Check:
    """Every velocity lies between those to the frame before and after, with some room.

    Positions that are kept too seldom say little about velocities: then this is skipped.
    """
    steps_s = np.diff(take.stamp_s)
    if len(steps_s) == 0 or take.joint_position.shape[1] == 0 or np.median(1 / steps_s) < _SLOWEST_FRAMES_PER_S:
        return Check("velocity", True, 0.0, VELOCITY, "", "skipped: too few frames per second")
    mean = np.diff(take.joint_position.astype(np.float64), axis=0) / steps_s[:, None]
    before, after = np.concatenate([mean[:1], mean]), np.concatenate([mean, mean[-1:]])
    low, high = np.minimum(before, after), np.maximum(before, after)
    low[[0, -1]], high[[0, -1]] = np.minimum(low[[0, -1]], 0), np.maximum(high[[0, -1]], 0)
    outside = np.maximum(np.maximum(low - take.joint_velocity, take.joint_velocity - high), 0)
    share = outside / np.maximum(np.abs(mean).max(axis=0), 1e-3)
    t, j = np.unravel_index(share.argmax(), share.shape)
    where = f"frame {t}, joint {j} ({take.info.joints[j].name})"
    return _check("velocity", share.max(), VELOCITY, "of the highest", where)


def _contradictions(take: Take, view: View, depth_m: Float[np.ndarray, "T E"]) -> Bool[np.ndarray, "T E"]:
    """Whether an entity's visibility contradicts the images, either way.

    Seen means: inside the image, and within 3 x 3 pixels one of its link at its own depth. Stored depth is rounded, and
    missing beyond its range, so what hangs on that is accepted either way. In takes with a sensor model depth is noisy,
    smeared sideways and has holes: there an entity may be seen if its link is there and depth does not forbid it within
    5 x 5 pixels, and must be seen only if noise cannot explain it.
    """
    camera, sensor = view.clip.camera, has_sensed_depth(take.info)
    links = np.array([1 + e.link for e in take.info.entities], dtype=np.int64)
    inside = (view.uv_px >= 0).all(axis=-1) & (view.uv_px < [camera.width, camera.height]).all(axis=-1)
    t, e = np.nonzero(inside)
    same = _around(view.link_id, t, view.uv_px[t, e], 1, fill=0) == links[e][:, None]
    may, must = np.zeros(inside.shape, bool), np.zeros(inside.shape, bool)
    if view.clip.depth_m is None:
        may[t, e] = same.any(axis=1)
    else:
        z = depth_m[t, e][:, None]
        room = DEPTH_SCALE_M + (_SENSOR_M + _SENSOR_PER_M * z**2 if sensor else 0)
        within = VISIBLE_WITHIN * take.info.half_diagonal_m
        close = _around(view.clip.depth_m, t, view.uv_px[t, e], 1, fill=np.nan)
        off = np.where(close > 0, np.abs(close - z), np.nan)  # comparisons with NaN are false
        must[t, e] = (same & (off <= within - room)).any(axis=1)
        allowed = (off <= within + room) | (close == 0)
        may[t, e] = (same & allowed).any(axis=1)
        if sensor:
            wide = _around(view.clip.depth_m, t, view.uv_px[t, e], _SENSOR_REACH_PX, fill=np.nan)
            may[t, e] = same.any(axis=1) & ((np.abs(wide - z) <= within + room) | (wide == 0)).any(axis=1)
    return (view.visible & ~may) | (must & ~view.visible)


def _around(
    image: np.ndarray, t: np.ndarray, uv_px: Float[np.ndarray, "N 2"], reach: int, *, fill: float
) -> np.ndarray:
    """The ``(2 reach + 1)^2`` pixels around each pixel, one row each; ``fill`` outside the image."""
    height, width = image.shape[1:]
    dy, dx = (d.ravel() for d in np.mgrid[-reach : reach + 1, -reach : reach + 1])
    x, y = uv_px[:, :1].astype(np.int64) + dx, uv_px[:, 1:].astype(np.int64) + dy
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    values = image[t[:, None], np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)]
    return np.where(inside, values, fill)


def _place(take: Take, values: np.ndarray) -> str:
    """Frame and entity of the largest value of ``[T, E]``."""
    if values.size == 0:
        return "no entities"
    t, e = np.unravel_index(int(values.argmax()), values.shape)
    return f"frame {t}, {take.info.entities[e].name}"


@dataclass(frozen=True)
class TakeReport:
    """What verifying one take found."""

    name: str
    frames: int
    """0 if it cannot be read, as of views."""
    views: int
    checks: tuple[Check, ...]
    """Every check, those of views once per view."""
    problem: str = ""
    """Why it cannot be read; empty if it can."""

    @property
    def passed(self) -> bool:
        """Whether it can be read and keeps every limit."""
        return not self.problem and all(check.passed for check in self.checks)

    def worst(self, name: str) -> Check | None:
        """The worst of the checks of a name over all views; None if it was not made."""
        return max((c for c in self.checks if c.name == name), key=lambda c: (not c.passed, c.worst), default=None)

    def message(self) -> str:
        """What is wrong, in one line; empty if nothing is."""
        if self.problem:
            return self.problem if self.name in self.problem else f"take {self.name!r}: {self.problem}"
        found = "; ".join(str(check) for check in self.checks if not check.passed)
        return f"take {self.name!r}: {found}" if found else ""


@dataclass(frozen=True)
class StoreReport:
    """What verifying the takes of a store found."""

    takes: tuple[TakeReport, ...]
    """One report per take, in order of their names."""

    @property
    def passed(self) -> bool:
        """Whether every take passed."""
        return all(take.passed for take in self.takes)

    @property
    def failed(self) -> tuple[TakeReport, ...]:
        """The takes that did not pass."""
        return tuple(take for take in self.takes if not take.passed)

    def worst(self, name: str) -> tuple[str, Check] | None:
        """The worst result of a check over all takes, and the take's name; None if it was never made."""
        found = [(take.name, check) for take in self.takes for check in [take.worst(name)] if check is not None]
        return max(found, key=lambda pair: (not pair[1].passed, pair[1].worst), default=None)

    def check_names(self) -> list[str]:
        """Names of all checks that were made, in the order in which they are made."""
        return list(dict.fromkeys(check.name for take in self.takes for check in take.checks))


def verify_take(store: TakeStore, name: str) -> TakeReport:
    """Read a take, view by view, and check it."""
    try:
        header = store.header(name)
        checks = tuple(_checks(store, name, header))
    except QuestError as error:
        return TakeReport(name, 0, 0, (), " ".join(str(error).split()))
    return TakeReport(name, header.frames, len(header.cameras), checks)


def verify_store(
    store: TakeStore, names: Sequence[str] | None = None, *, report: Callable[[TakeReport], None] = lambda _: None
) -> StoreReport:
    """Check takes of a store, by default all, also those that cannot be read; reports each as soon as it is done."""
    done = []
    for name in names if names is not None else sorted({*store.names(), *store.problems()}):
        done.append(verify_take(store, name))
        report(done[-1])
    return StoreReport(tuple(done))


def _checks(store: TakeStore, name: str, header: TakeHeader) -> list[Check]:
    """All checks of a take, with one view in memory at a time."""
    truth, digest = store.read(name, views=[]), TakeHash(header.info, header.cameras)
    for path, array in take_arrays(truth):
        digest.add(path, array)
    checks = list(check_truth(truth))
    computable = all(check.passed for check in checks if check.name in ("indices", "finite"))
    for v in range(len(header.cameras)):
        view = store.read_view(name, v)
        for path, array in take_arrays(replace(truth, views=(view,))):
            if path.startswith("view_0/"):
                digest.add(path.replace("view_0", f"view_{v}"), array)
        if computable:
            checks += check_view(truth, view, v)
    found, recorded = digest.hexdigest(), header.data_hash
    where = "" if found == recorded else f"{found[:12]}, recorded {recorded[:12]}"
    return [_check("hash", found != recorded, where=where), *checks]
