"""What pulls in a take comes, takes hold of what is to move, moves with it, lets go and leaves.

While a joint moves a tool is fixed in the link that it holds. In the frames earlier and later it goes in straight lines
along its own axis, and around the object from one link to the next.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation, Slerp

from quest.errors import ConfigError, ObjectError
from quest.sim.articulation import apply
from quest.sim.entities import SimEntity
from quest.sim.grasp import Grasp, ObjectSamples, Tool
from quest.sim.motion import FRAMES_PER_S, MotionStyle, Share, minimum_jerk, share_plan
from quest.sim.objects import SimObject

_BEFORE, _AFTER = 8, 5
"""Frames that a tool needs at least, to come and to go."""
_CLOSING = (3, 6)
_FASTEST_M_PER_S = 1.6
_MOMENTS = 7
_STRAYS = 0.03
"""Share of its travel by which a joint may move while nothing holds it (an engine lags behind its script)."""


@runtime_checkable
class MovingPart(Protocol):
    """A part of what pulls; it is put into a scene and placed as a prop is."""

    @property
    def world_from_shape(self) -> Float[np.ndarray, "S 4 4"]:
        """Its pose at every frame of the script."""
        ...

    def add(self, scene: Any) -> Any:
        """Put it into a ``sapien.Scene``; returns what :meth:`place` moves."""
        ...

    def place(self, actors: Any, frame: int) -> None:
        """Move it to where it is at a frame of the script."""
        ...


@dataclass(frozen=True)
class Puller:
    """What pulls in a take; a prop."""

    parts: Sequence[MovingPart]
    grasps: tuple[tuple[str, int, int], ...]
    """Name of every entity that it holds, the first frame and the frame after the last."""

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


@dataclass(frozen=True)
class Pull:
    """Where a tool is at every frame of a script."""

    world_from_gripper: Float[np.ndarray, "S 4 4"]
    """Its pose."""
    opening_m: Float[np.ndarray, " S"]
    """Distance between its fingers."""
    turn: Float[np.ndarray, " S"]
    """Index of the grasp that it is set to; between two of them on its way from one to the next."""
    grasps: tuple[Grasp, ...]
    """How it holds one entity after the other."""
    held: tuple[tuple[str, int, int], ...]
    """Name of every entity that it holds, the first frame and the frame after the last."""


FindGrasp = Callable[
    [SimObject, SimEntity, ObjectSamples, Float[np.ndarray, "M B 4 4"]],
    tuple[Grasp, float],
]
"""The best way to hold an entity while its joint moves, and what it costs; raises ObjectError if there is none."""


def plan_pull(
    sim_object: SimObject,
    script: Float[np.ndarray, "S J"],
    moved_joints: tuple[int, ...],
    *,
    margin: tuple[int, int],
    frames_per_joint: int,
    rng: np.random.Generator,
    noun: str,
    find: FindGrasp,
) -> Pull:
    """How a tool pulls one joint after the other.

    Args:
        sim_object: the object.
        script: joint positions at every frame, as played.
        moved_joints: joints that move, in order.
        margin: frames at the start and at the end of each joint's share in which it does not move.
        frames_per_joint: length of a share.
        rng: what its ways are drawn from.
        noun: what messages call the tool.
        find: how it takes hold of an entity.

    Raises:
        ConfigError: the margins leave it no time, or joints move outside of their shares.
        ObjectError: something that moves can be grasped nowhere.
    """
    shares = share_plan(moved_joints, frames_per_joint=frames_per_joint, style=MotionStyle(margin=margin))
    _check_time(sim_object, script, shares, margin, noun)
    poses = sim_object.articulation.poses(script)
    samples = ObjectSamples(sim_object.articulation)
    grasps = tuple(_grasp(sim_object, share, samples, poses, noun, find) for share in shares)
    way = _Way(sim_object, poses, rng, grasps)
    way.go_through(shares)
    held = tuple((g.entity.name, s.moves - 1, s.stops) for g, s in zip(grasps, shares, strict=True))
    return Pull(way.gripper, way.opening, way.turn, grasps, held)


def _check_time(
    sim_object: SimObject, script: Float[np.ndarray, "S J"], shares: list[Share], margin: tuple[int, int], noun: str
) -> None:
    if margin[0] < _BEFORE or margin[1] < _AFTER:
        raise ConfigError(
            f"{noun}: expected margins of at least {_BEFORE} and {_AFTER} frames to come and to go, got {margin}"
        )
    if len(script) < shares[-1].end:
        raise ConfigError(f"{noun}: expected a script of {shares[-1].end} frames, got {len(script)}")
    for share in shares:
        path = script[:, share.joint]
        free = np.concatenate((path[: share.moves] - path[0], path[share.stops :] - path[-1]))
        if np.abs(free).max(initial=0.0) > _STRAYS * max(np.ptp(path), 1e-9):
            name = sim_object.articulation.joints[share.joint].joint.name
            raise ConfigError(
                f"{noun}: expected {name} to move within frames {share.moves} to {share.stops} only, got motion "
                f"outside; one {noun} needs joints that move once, one after the other, with its margins"
            )


def _grasp(
    sim_object: SimObject,
    share: Share,
    samples: ObjectSamples,
    poses: Float[np.ndarray, "S B 4 4"],
    noun: str,
    find: FindGrasp,
) -> Grasp:
    """How the best of a joint's entities is held."""
    moments = poses[np.unique(np.linspace(share.moves - 1, share.stops - 1, _MOMENTS).astype(int))]
    entities = [e for e in sim_object.entities if e.joint == share.joint and e.label != "hinge"]
    found: list[tuple[float, int, Grasp]] = []
    problem: ObjectError | None = None
    for n, entity in enumerate(entities):
        try:
            grasp, cost = find(sim_object, entity, samples, moments)
        except ObjectError as error:
            problem = error
            continue
        found.append((cost, n, grasp))
    if not found:
        name = sim_object.articulation.joints[share.joint].joint.name
        raise problem or ObjectError(
            f"{sim_object.object_id}: expected an entity on {name} for the {noun} to hold, found none"
        )
    return min(found)[2]


class _Way:
    """Where the tool is at every frame, and how far it is open; drawn from its first frame to its last."""

    def __init__(
        self,
        sim_object: SimObject,
        poses: Float[np.ndarray, "S B 4 4"],
        rng: np.random.Generator,
        grasps: tuple[Grasp, ...],
    ) -> None:
        self._poses, self._rng, self._grasps = poses, rng, grasps
        hulls = sim_object.articulation.body_hulls
        moments = poses[np.unique(np.linspace(0, len(poses) - 1, 12).astype(int))]
        swept = np.concatenate([apply(p[b], h) for p in moments for b, h in enumerate(hulls) if len(h)])
        self._low, self._high = swept.min(axis=0), swept.max(axis=0)
        self._half_diagonal_m = sim_object.half_diagonal_m
        self.gripper = np.tile(np.eye(4), (len(poses), 1, 1))
        self.opening, self.turn = np.zeros(len(poses)), np.zeros(len(poses))
        self._frame, self._pose, self._open_m, self._turn = 0, np.eye(4), 0.0, 0

    def go_through(self, shares: list[Share]) -> None:
        """Fills in poses, openings and turns: one grasp after the other, and the ways between."""
        before: Grasp | None = None
        for n, (share, grasp) in enumerate(zip(shares, self._grasps, strict=True)):
            coming = share.moves - self._frame
            closing = int(np.clip(coming // 6, *_CLOSING))
            held = self._poses[share.moves - 1, grasp.entity.body] @ grasp.body_from_gripper
            fixed, ready = grasp.body_from_gripper, _back(held, grasp.back_m)
            if before is None:  # from outside of the picture, or as far away as it gets in time
                straight = (coming - closing) // 2
                self._pose = self._outside(grasp.tool, ready, coming - closing - straight)
                self._open_m = grasp.open_m
                self._go(coming - closing - straight, ready)
            else:
                left = self._poses[self._frame - 1, before.entity.body] @ before.body_from_gripper
                cleared = _back(left, before.back_m)
                # If its two sides are alike: turn by less than a quarter.
                if grasp.tool.sides_alike and np.sum(cleared[:3, 1] * ready[:3, 1]) < 0:
                    held, ready, fixed = held @ _HALF_TURN, ready @ _HALF_TURN, fixed @ _HALF_TURN
                opening = max(2, closing - 1)
                straight = (coming - opening - closing) // 3
                self._pose = left
                self._go(opening, left, before.open_m)
                self._go(straight, cleared)
                self._go(coming - closing - opening - 2 * straight, ready, grasp.open_m, around=True)
            self._go(straight, held)
            self._go(closing, held, grasp.width_m)
            frames = slice(share.moves, share.stops)
            self.gripper[frames] = self._poses[frames, grasp.entity.body] @ fixed
            self.opening[frames], self.turn[frames] = grasp.width_m, n
            self._frame, before = share.stops, grasp
        self._leave(self._grasps[-1])

    def _leave(self, grasp: Grasp) -> None:
        self._pose = self.gripper[self._frame - 1]
        cleared, rest = _back(self._pose, grasp.back_m), len(self._poses) - self._frame
        opening = max(2, min(4, rest // 4))
        straight = (rest - opening + 1) // 2
        self._go(opening, self._pose, grasp.open_m)
        self._go(straight, cleared)
        self._go(rest - opening - straight, self._outside(grasp.tool, cleared, rest - opening - straight))

    def _go(
        self, frames: int, goal: Float[np.ndarray, "4 4"], open_m: float | None = None, *, around: bool = False
    ) -> None:
        """Fills some frames with a movement that reaches its goal at the last of them; ``around`` to the next grasp."""
        start, opened, turn = self._pose, self._open_m, self._turn
        self._pose, self._open_m = goal, opened if open_m is None else open_m
        self._turn += around
        if frames <= 0:
            return
        share = minimum_jerk(np.arange(1, frames + 1) / frames)
        path = (1 - share)[:, None] * start[:3, 3] + share[:, None] * goal[:3, 3]
        if around:
            path += (4 * share * (1 - share))[:, None] * self._detour(start[:3, 3], goal[:3, 3])
        turns = Slerp([0.0, 1.0], Rotation.from_matrix(np.stack((start[:3, :3], goal[:3, :3]))))
        now = slice(self._frame, self._frame + frames)
        self.gripper[now, :3, :3] = turns(share).as_matrix()
        self.gripper[now, :3, 3] = path
        self.opening[now] = opened + share * (self._open_m - opened)
        self.turn[now] = turn + share * (self._turn - turn)
        self._frame += frames

    def _outside(self, tool: Tool, ready: Float[np.ndarray, "4 4"], frames: int) -> Float[np.ndarray, "4 4"]:
        """Above or beside all that the object sweeps; not as far if there is no time to get there."""
        place, room = ready[:3, 3], 0.3 * self._half_diagonal_m + tool.length_m * tool.scale
        edges = [(self._high if sign > 0 else self._low)[axis] for axis, sign in tool.exits]
        rest = [sign * (edge - place[axis]) for edge, (axis, sign) in zip(edges, tool.exits, strict=True)]
        # The shorter the likelier; a beaten path is a cue that no tracker should learn.
        lengths = np.array([max(length, 0.0) + room for length in rest])
        weights = lengths**-3.0
        way = int(self._rng.choice(len(lengths), p=weights / weights.sum()))
        length = min(lengths[way], _FASTEST_M_PER_S * tool.scale**0.5 * frames / FRAMES_PER_S)
        axis, sign = tool.exits[way]
        towards = sign * np.eye(3)[axis] + tool.exit_back * ready[:3, 2]
        pose = ready.copy()
        pose[:3, 3] += length * towards / np.linalg.norm(towards)
        pose[2, 3] = max(pose[2, 3], tool.length_m * tool.scale * 0.2)
        return pose

    def _detour(self, start: Float[np.ndarray, "3"], goal: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """By how much the middle of a straight way has to move away to stay clear of all that the object sweeps."""
        middle, margin = (start + goal) / 2, 0.05 * self._grasps[0].tool.scale
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
    """A tool that went straight back."""
    moved = pose.copy()
    moved[:3, 3] += length_m * pose[:3, 2]
    return moved


_HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
