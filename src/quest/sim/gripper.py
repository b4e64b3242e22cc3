"""A gripper that comes, takes hold of what is to move, moves with it, lets go and leaves: a prop of a take.

While a joint moves the gripper is fixed in the link that it holds. In the frames before and after, it goes in straight
lines along its own axis, and around the object from one link to the next.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation, Slerp

from quest.errors import ConfigError, ObjectError
from quest.sim.articulation import apply
from quest.sim.grasp import Grasp, ObjectSamples, find_grasp, gripper_scale
from quest.sim.gripper_shape import GRIPPER_PARTS, LENGTH_M, sample_gripper_surfaces
from quest.sim.motion import FRAMES_PER_S, MotionStyle, Share, minimum_jerk, share_plan
from quest.sim.objects import SimObject
from quest.sim.occluder import Occluder, Shape

_BEFORE, _AFTER = 8, 5
"""Frames that the gripper needs at least, to come and to go."""
_CLOSING = (3, 6)
_FASTEST_M_PER_S = 1.6
_MOMENTS = 7
_STRAYS = 0.03
"""Share of its travel by which a joint may move while nothing holds it (an engine lags behind its script)."""


@dataclass(frozen=True)
class Gripper:
    """A gripper that moves; a prop.

    Attributes:
        parts: its parts with their materials and poses.
        grasps: name of every entity that it holds, the first frame and the frame after the last.
    """

    parts: tuple[Occluder, ...]
    grasps: tuple[tuple[str, int, int], ...]

    @property
    def world_from_part(self) -> Float[np.ndarray, "S P 4 4"]:
        """Pose of every part at every frame of the script."""
        return np.stack([p.world_from_shape for p in self.parts], axis=1)

    def add(self, scene: Any) -> Any:
        """Put it into a ``sapien.Scene``; returns the entities that :meth:`place` moves."""
        return [part.add(scene) for part in self.parts]

    def place(self, actors: Any, frame: int) -> None:
        """Move its entities to where they are at a frame of the script."""
        for actor, part in zip(actors, self.parts, strict=True):
            part.place(actor, frame)

    def pose(self, frame: int) -> Float[np.ndarray, "P 4 4"]:
        """Where its parts are at a frame of the script."""
        return np.stack([part.world_from_shape[frame] for part in self.parts])


def plan_gripper(
    sim_object: SimObject,
    script: Float[np.ndarray, "S J"],
    moved_joints: tuple[int, ...],
    *,
    margin: tuple[int, int],
    frames_per_joint: int,
    rng: np.random.Generator,
) -> Gripper:
    """A gripper that pulls one joint after the other.

    Args:
        sim_object: the object.
        script: joint positions at every frame, as played.
        moved_joints: joints that move, in order.
        margin: frames at the start and at the end of each joint's share in which it does not move.
        frames_per_joint: length of a share.
        rng: what its looks and its ways are drawn from.

    Raises:
        ConfigError: the margins leave it no time, or joints move outside of their shares.
        ObjectError: something that moves can be grasped nowhere.
    """
    shares = share_plan(moved_joints, frames_per_joint=frames_per_joint, style=MotionStyle(margin=margin))
    _check_time(sim_object, script, shares, margin)
    poses = np.stack([sim_object.articulation.poses(position) for position in script])
    samples = ObjectSamples(sim_object.articulation)
    grasps = [_grasp(sim_object, share, samples, poses) for share in shares]
    surfaces, scale = sample_gripper_surfaces(rng), gripper_scale(sim_object.half_diagonal_m)
    gripper, opening = _Way(sim_object, poses, shares, grasps, rng).travel()
    parts = []
    for part in GRIPPER_PARTS:
        local = np.tile(np.eye(4), (len(script), 1, 1))
        local[:, :3, 3] = scale * np.array(part.centre_m)
        local[:, 1, 3] += part.side * opening / 2
        half = scale * np.array(part.half_m)
        if part.kind == "cylinder":  # whose axis is x
            local[:, :3, :3], half = _ALONG_Z, half[[2, 0, 1]]
        parts.append(Occluder(Shape(part.kind, half, np.eye(4)), surfaces[part.material], gripper @ local))
    held = tuple((g.entity.name, s.moves - 1, s.stops) for g, s in zip(grasps, shares, strict=True))
    return Gripper(tuple(parts), held)


def _check_time(
    sim_object: SimObject, script: Float[np.ndarray, "S J"], shares: list[Share], margin: tuple[int, int]
) -> None:
    if margin[0] < _BEFORE or margin[1] < _AFTER:
        raise ConfigError(
            f"gripper: expected margins of at least {_BEFORE} and {_AFTER} frames to come and to go, got {margin}"
        )
    if len(script) < shares[-1].end:
        raise ConfigError(f"gripper: expected a script of {shares[-1].end} frames, got {len(script)}")
    for share in shares:
        path = script[:, share.joint]
        free = np.concatenate((path[: share.moves] - path[0], path[share.stops :] - path[-1]))
        if np.abs(free).max(initial=0.0) > _STRAYS * max(np.ptp(path), 1e-9):
            name = sim_object.articulation.joints[share.joint].joint.name
            raise ConfigError(
                f"gripper: expected {name} to move within frames {share.moves} to {share.stops} only, got motion "
                "outside; one gripper needs joints that move once, one after the other, with its margins"
            )


def _grasp(sim_object: SimObject, share: Share, samples: ObjectSamples, poses: Float[np.ndarray, "S B 4 4"]) -> Grasp:
    """How the best of a joint's entities is held."""
    moments = poses[np.unique(np.linspace(share.moves - 1, share.stops - 1, _MOMENTS).astype(int))]
    entities = [e for e in sim_object.entities if e.joint == share.joint and e.label != "hinge"]
    found: list[tuple[float, int, Grasp]] = []
    problem: ObjectError | None = None
    for n, entity in enumerate(entities):
        try:
            grasp, cost = find_grasp(sim_object, entity, samples, moments)
        except ObjectError as error:
            problem = error
            continue
        found.append((cost, n, grasp))
    if not found:
        name = sim_object.articulation.joints[share.joint].joint.name
        raise problem or ObjectError(
            f"{sim_object.object_id}: expected an entity on {name} for the gripper to hold, found none"
        )
    return min(found)[2]


class _Way:
    """Where the gripper is at every frame, and how far it is open."""

    def __init__(
        self,
        sim_object: SimObject,
        poses: Float[np.ndarray, "S B 4 4"],
        shares: list[Share],
        grasps: list[Grasp],
        rng: np.random.Generator,
    ) -> None:
        self._poses, self._shares, self._grasps = poses, shares, grasps
        self._scale = gripper_scale(sim_object.half_diagonal_m)
        hulls = sim_object.articulation.body_hulls
        moments = poses[np.unique(np.linspace(0, len(poses) - 1, 12).astype(int))]
        swept = np.concatenate([apply(p[b], h) for p in moments for b, h in enumerate(hulls) if len(h)])
        self._low, self._high = swept.min(axis=0), swept.max(axis=0)
        self._room = 0.3 * sim_object.half_diagonal_m + LENGTH_M * self._scale
        self._rng = rng
        self._gripper = np.tile(np.eye(4), (len(poses), 1, 1))
        self._opening = np.zeros(len(poses))

    def travel(self) -> tuple[Float[np.ndarray, "S 4 4"], Float[np.ndarray, " S"]]:
        """Poses of the gripper in the world, and the distance between its pads."""
        for k, (share, grasp) in enumerate(zip(self._shares, self._grasps, strict=True)):
            self._hold(share, grasp)
            free_from = 0 if k == 0 else self._shares[k - 1].stops
            coming = share.moves - free_from
            closing = int(np.clip(coming // 6, *_CLOSING))
            if k == 0:
                straight = (coming - closing) // 2
                self._come(grasp, share.moves, closing, straight, first=0)
            else:
                self._change(k, closing)
        last = self._shares[-1]
        self._leave(self._grasps[-1], last.stops, len(self._poses))
        return self._gripper, self._opening

    def _held(self, grasp: Grasp, frame: int) -> Float[np.ndarray, "4 4"]:
        return self._poses[frame, grasp.entity.body] @ grasp.body_from_gripper

    def _hold(self, share: Share, grasp: Grasp) -> None:
        frames = slice(share.moves - 1, share.stops)
        self._gripper[frames] = self._poses[frames, grasp.entity.body] @ grasp.body_from_gripper
        self._opening[frames] = grasp.width_m

    def _come(self, grasp: Grasp, moves: int, closing: int, straight: int, *, first: int) -> None:
        """From outside of the picture, or as far away as it gets in time, to the entity."""
        held = self._held(grasp, moves - 1)
        ready = _back(held, grasp.back_m)
        outside = self._outside(ready, moves - closing - straight - first)
        self._segment(first, moves - closing - straight, outside, ready, grasp.open_m, grasp.open_m)
        self._approach(grasp, ready, held, moves, closing, straight)

    def _approach(
        self,
        grasp: Grasp,
        ready: Float[np.ndarray, "4 4"],
        held: Float[np.ndarray, "4 4"],
        moves: int,
        closing: int,
        straight: int,
    ) -> None:
        self._segment(moves - closing - straight, moves - closing, ready, held, grasp.open_m, grasp.open_m)
        self._segment(moves - closing, moves, held, held, grasp.open_m, grasp.width_m)

    def _change(self, k: int, closing: int) -> None:
        """From one entity to the next."""
        before, after, stops, moves = (
            self._grasps[k - 1],
            self._grasps[k],
            self._shares[k - 1].stops,
            self._shares[k].moves,
        )
        left, held = self._held(before, stops - 1), self._held(after, moves - 1)
        cleared, ready = _back(left, before.back_m), _back(held, after.back_m)
        if np.sum(cleared[:3, 1] * ready[:3, 1]) < 0:  # its two sides are alike: turn by less than a quarter
            held, ready = held @ _HALF_TURN, ready @ _HALF_TURN
            frames = slice(moves - 1, self._shares[k].stops)
            self._gripper[frames] = self._gripper[frames] @ _HALF_TURN
        opening = max(2, closing - 1)
        straight = (moves - stops - opening - closing) // 3
        self._segment(stops, stops + opening, left, left, before.width_m, before.open_m)
        self._segment(stops + opening, stops + opening + straight, left, cleared, before.open_m, before.open_m)
        first, end = stops + opening + straight, moves - closing - straight
        self._segment(first, end, cleared, ready, before.open_m, after.open_m, around=True)
        self._approach(after, ready, held, moves, closing, straight)

    def _leave(self, grasp: Grasp, stops: int, frames: int) -> None:
        left = self._gripper[stops - 1]
        cleared = _back(left, grasp.back_m)
        opening = max(2, min(4, (frames - stops) // 4))
        straight = (frames - stops - opening + 1) // 2
        self._segment(stops, stops + opening, left, left, grasp.width_m, grasp.open_m)
        self._segment(stops + opening, stops + opening + straight, left, cleared, grasp.open_m, grasp.open_m)
        first = stops + opening + straight
        self._segment(first, frames, cleared, self._outside(cleared, frames - first), grasp.open_m, grasp.open_m)

    def _outside(self, ready: Float[np.ndarray, "4 4"], frames: int) -> Float[np.ndarray, "4 4"]:
        """Above or beside all that the object sweeps; not as far if there is no time to get there."""
        place = ready[:3, 3]
        ways = [(self._high[2] - place[2], (0.0, 0.0, 1.0)), (self._high[1] - place[1], (0.0, 1.0, 0.0))]
        ways.append((place[1] - self._low[1], (0.0, -1.0, 0.0)))
        # The shorter the likelier; a beaten path is a cue that no tracker should learn.
        lengths = np.array([max(length, 0.0) + self._room for length, _ in ways])
        weights = lengths**-3.0
        way = int(self._rng.choice(3, p=weights / weights.sum()))
        length = min(lengths[way], _FASTEST_M_PER_S * self._scale**0.5 * frames / FRAMES_PER_S)
        towards = np.array(ways[way][1]) + 0.3 * ready[:3, 2]
        pose = ready.copy()
        pose[:3, 3] += length * towards / np.linalg.norm(towards)
        pose[2, 3] = max(pose[2, 3], LENGTH_M * self._scale * 0.2)
        return pose

    def _segment(
        self,
        first: int,
        end: int,
        start: Float[np.ndarray, "4 4"],
        goal: Float[np.ndarray, "4 4"],
        opening: float,
        closing: float,
        *,
        around: bool = False,
    ) -> None:
        """Fills frames ``first`` to ``end`` with a movement that reaches its goal at the last of them."""
        frames = end - first
        if frames <= 0:
            return
        share = minimum_jerk(np.arange(1, frames + 1) / frames)
        path = (1 - share)[:, None] * start[:3, 3] + share[:, None] * goal[:3, 3]
        if around:
            path += (4 * share * (1 - share))[:, None] * self._detour(start[:3, 3], goal[:3, 3])
        turns = Slerp([0.0, 1.0], Rotation.from_matrix(np.stack((start[:3, :3], goal[:3, :3]))))
        self._gripper[first:end, :3, :3] = turns(share).as_matrix()
        self._gripper[first:end, :3, 3] = path
        self._opening[first:end] = opening + share * (closing - opening)

    def _detour(self, start: Float[np.ndarray, "3"], goal: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """By how much the middle of a straight way has to move away to stay clear of all that the object sweeps."""
        middle, margin = (start + goal) / 2, 0.05 * self._scale
        depth = np.minimum(middle - self._low, self._high - middle) + margin
        if (depth <= 0).any() or np.linalg.norm(goal - start) < 1e-6:
            return np.zeros(3)
        shift = np.zeros(3)
        # Out of the box through the front, the top or a side, whichever is nearest; not through the back or the floor.
        outs = {(0, 1): self._high[0] - middle[0], (2, 1): self._high[2] - middle[2]}
        outs[1, 1], outs[1, -1] = self._high[1] - middle[1], middle[1] - self._low[1]
        (axis, sign), length = min(outs.items(), key=lambda item: item[1])
        shift[axis] = sign * (length + margin)
        return shift


def _back(pose: Float[np.ndarray, "4 4"], length_m: float) -> Float[np.ndarray, "4 4"]:
    """A gripper that went straight back."""
    moved = pose.copy()
    moved[:3, 3] += length_m * pose[:3, 2]
    return moved


_ALONG_Z = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]).T
_HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
