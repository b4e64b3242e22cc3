"""Props: what stands in a scene beside the object and its surroundings, and may move or change.

An occluder comes between a camera and what it hides, stays a while and goes away again. A disturbance is light that
changes, odd materials, or a camera that is hit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, Protocol, get_args, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull, QhullError

from quest.sim.appearance import add_shape
from quest.sim.articulation import apply
from quest.sim.cameras import PosedCamera
from quest.sim.motion import HOLD_FRAMES
from quest.sim.surfaces import Surface, make_material, sample_surface


@runtime_checkable
class Prop(Protocol):
    """Something that is put into a scene once and placed anew at every frame of the script."""

    def add(self, scene: Any) -> Any:
        """Put it into a ``sapien.Scene`` that has its lights already; returns what :meth:`place` moves."""
        ...

    def place(self, actors: Any, frame: int) -> None:
        """Bring what :meth:`add` returned to where it is at a frame of the script."""
        ...

    def pose(self, frame: int) -> np.ndarray:
        """Numbers that are the same at two frames if and only if nothing about it differs between them."""
        ...


_FORMS = {"board": 0.35, "box": 0.3, "column": 0.2, "disc": 0.15}
_TILT_DEG = 18.0
_NEAREST = (0.55, 0.92)
"""Where its farthest point lies between the camera and the nearest point of the object, shares of the depth."""
_LARGEST = 0.45
"""It hides at most this share of the image."""
_GROWTH = 1.05
_CORNERS = 32


@dataclass(frozen=True)
class Shape:
    """A box or a cylinder before a camera."""

    kind: Literal["box", "cylinder"]
    """A cylinder's axis is x."""
    half_m: Float[np.ndarray, "3"]
    """Half extents along x, y, z; a cylinder's last two are its radius."""
    cam_from_shape: Float[np.ndarray, "4 4"]
    """Its pose."""

    @property
    def vertices(self) -> Float[np.ndarray, "N 3"]:
        """Its corners in the camera's frame; a cylinder's are those of a prism that it holds."""
        if self.kind == "box":
            corners = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3).astype(float)
        else:
            angle = np.linspace(0, 2 * np.pi, _CORNERS, endpoint=False)
            ring = np.stack((np.ones(_CORNERS), np.cos(angle), np.sin(angle)), axis=-1)
            corners = np.concatenate((ring, ring * [-1, 1, 1]))
        return apply(self.cam_from_shape, corners * self.half_m)

    @property
    def outline(self) -> ConvexHull:
        """What it covers of the plane at depth 1 before the camera."""
        vertices = self.vertices
        return ConvexHull(vertices[:, :2] / vertices[:, 2:])

    def hides(self, slopes: Float[np.ndarray, "N 2"]) -> Bool[np.ndarray, " N"]:
        """Which rays from the camera, given by x / z and y / z, it meets."""
        sides = self.outline.equations
        return np.all(slopes @ sides[:, :2].T + sides[:, 2] <= 1e-9, axis=1)


@dataclass(frozen=True)
class Occluder:
    """A shape with a material that moves."""

    shape: Shape
    """What it is, at the place where it hides something."""
    surface: Surface
    world_from_shape: Float[np.ndarray, "T 4 4"]
    """Its pose at every frame of the script."""

    def add(self, scene: Any) -> Any:
        """Put it into a ``sapien.Scene``; returns the entity that :meth:`place` moves."""
        import sapien

        half, material = self.shape.half_m.astype(np.float32).tolist(), make_material(self.surface)
        if self.shape.kind == "box":
            shape: Any = sapien.render.RenderShapeBox(half, material)
        else:
            shape = sapien.render.RenderShapeCylinder(half[1], half[0], material)
        return add_shape(scene, shape, sapien.Pose(self.world_from_shape[0]))

    def place(self, actors: Any, frame: int) -> None:
        """Move its entity to where it is at a frame of the script."""
        import sapien

        actors.set_pose(sapien.Pose(self.world_from_shape[frame]))

    def pose(self, frame: int) -> Float[np.ndarray, "4 4"]:
        """Where it is at a frame of the script."""
        return self.world_from_shape[frame]


def fit_shape(
    slopes: Float[np.ndarray, "N 2"], posed: PosedCamera, nearest_m: float, rng: np.random.Generator
) -> Shape | None:
    """A random shape that hides all given rays (x / z, y / z) and stands nearer to the camera than ``nearest_m``.

    None if it would hide too much of the image.
    """
    form = str(rng.choice(list(_FORMS), p=list(_FORMS.values())))
    roll, thick = float(rng.normal(0, np.deg2rad(12))), float(rng.uniform(0.02, 0.1))
    tilt = np.deg2rad(rng.uniform(-_TILT_DEG, _TILT_DEG, 2))
    room, place = float(rng.uniform(1.02, 1.12)), float(rng.uniform(*_NEAREST))
    if form in ("box", "column"):
        thick = float(rng.uniform(0.3, 0.9))
    turned = slopes @ _turn(2, roll)[:2, :2]
    low, high = turned.min(axis=0), turned.max(axis=0)
    a, b = (high - low) / 2
    rotation = _turn(2, roll) @ _turn(0, float(tilt[0])) @ _turn(1, float(tilt[1]))
    kind: Literal["box", "cylinder"] = "cylinder" if form in ("column", "disc") else "box"
    half = [a, b, thick * min(a, b)]
    if form == "column":  # along its longer side
        half, rotation = ([a, b, b], rotation) if a > b else ([b, a, a], rotation @ _UP)
    elif form == "disc":
        half, rotation = [thick * max(a, b), max(a, b), max(a, b)], rotation @ _TOWARDS
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:2, 3], pose[2, 3] = _turn(2, roll)[:2, :2] @ ((low + high) / 2), 1.0
    camera = posed.camera
    image = camera.width / camera.fx * camera.height / camera.fy
    shape = Shape(kind, room * np.array(half), pose)
    # The sides of what is thick or tilted do not all look at the camera: grow until everything is hidden.
    while not _fits(shape, slopes):
        shape = Shape(kind, shape.half_m * _GROWTH, pose)
        if shape.vertices[:, 2].min() < 0.2 or shape.outline.volume > _LARGEST * image:
            return None
    if shape.outline.volume > _LARGEST * image:
        return None
    # Shrunk towards the camera's centre it hides just the same.
    scale = place * nearest_m / shape.vertices[:, 2].max()
    pose[:3, 3] *= scale
    return Shape(kind, shape.half_m * scale, pose)


def _fits(shape: Shape, slopes: Float[np.ndarray, "N 2"]) -> bool:
    try:
        return bool(shape.hides(slopes).all())
    except QhullError:
        return False


def slide_in(
    shape: Shape, posed: PosedCamera, away: Float[np.ndarray, " T"], rng: np.random.Generator
) -> Float[np.ndarray, "T 4 4"]:
    """Poses in the world of a shape that comes from beyond a random edge of the image, parallel to the image.

    ``away`` says how far it is at every frame: 0 in place, 1 gone: far below the ground, where it casts no shadow.
    """
    camera, vertices = posed.camera, shape.vertices
    axis, side = int(rng.choice(2, p=(0.7, 0.3))), int(rng.integers(2))
    centre, focal, length = ((camera.cx, camera.fx, camera.width), (camera.cy, camera.fy, camera.height))[axis]
    edge = ((0 if side == 0 else length) - centre) / focal
    beyond = edge + (-0.02 if side == 0 else 0.02)
    shifts = beyond * vertices[:, 2] - vertices[:, axis]
    shift = np.zeros(3)
    shift[axis] = min(shifts.min(), 0.0) if side == 0 else max(shifts.max(), 0.0)
    poses = np.tile(shape.cam_from_shape, (len(away), 1, 1))
    poses[:, :3, 3] += away[:, None] * shift
    poses = np.linalg.inv(posed.cam_from_world) @ poses
    poses[away >= 1, 2, 3] -= 100 * vertices[:, 2].max()
    return poses


def sample_occluder_surface(rng: np.random.Generator) -> Surface:
    """Draw its material."""
    return sample_surface(rng, textured=0.6)


def _turn(axis: int, angle_rad: float) -> Float[np.ndarray, "3 3"]:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[[i, i, j, j], [i, j, i, j]] = c, -s, s, c
    return matrix


# Rotations that bring a cylinder's axis, which is x, upright, or towards the camera.
_UP = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_TOWARDS = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])


Disturbance = Literal["none", "light", "texture", "bump"]
DISTURBANCES: tuple[Disturbance, ...] = get_args(Disturbance)

_FADE_FRAMES = (1, 12)
_AMBIENT = (0.35, 1.8)
_LAMPS = (0.15, 1.6)


def disturbed_at(frames: int, rng: np.random.Generator) -> int:
    """A frame in the middle of a script, after its hold, at which something happens."""
    return max(HOLD_FRAMES, int(frames * rng.uniform(0.25, 0.65)))


@dataclass(frozen=True)
class LightChange:
    """Lamps and daylight that change their strength and colour once, within a few frames; a prop."""

    ambient: Float[np.ndarray, "S 3"]
    """Factors of the light from everywhere, linear red, green, blue, at every frame of the script."""
    lamps: Float[np.ndarray, "S 3"]
    """Factors of all other lights likewise."""

    def add(self, scene: Any) -> Any:
        """Finds the lights of a ``sapien.Scene``; returns them with their colours, and the scene."""
        import sapien

        found = [c for entity in scene.entities for c in entity.components]
        lamps = [c for c in found if isinstance(c, sapien.render.RenderLightComponent)]
        return scene, np.asarray(scene.ambient_light), [(lamp, np.asarray(lamp.color)) for lamp in lamps]

    def place(self, actors: Any, frame: int) -> None:
        """Light as it is at a frame of the script."""
        scene, ambient, lamps = actors
        scene.set_ambient_light((ambient * self.ambient[frame]).tolist())
        for lamp, colour in lamps:
            lamp.set_color((colour * self.lamps[frame]).tolist())

    def pose(self, frame: int) -> Float[np.ndarray, "2 3"]:
        """The factors at a frame."""
        return np.stack((self.ambient[frame], self.lamps[frame]))


def change_light(frames: int, rng: np.random.Generator) -> LightChange:
    """Draw how the light changes in a script of some frames: a lamp goes out, a blind opens, the white shifts."""
    start, fade = disturbed_at(frames, rng), int(rng.integers(_FADE_FRAMES[0], _FADE_FRAMES[1] + 1))
    share = np.clip((np.arange(frames) - start + 1) / fade, 0.0, 1.0)[:, None]
    factors = []
    for low, high in (_AMBIENT, _LAMPS):
        # Away from 1, either darker or brighter, so that every take of this kind does change.
        strength = rng.uniform(low, 0.6) if rng.random() < 0.6 else rng.uniform(1.35, high)
        tint = np.exp(rng.normal(0.0, 0.15, 3))
        factors.append(1 + share * (strength * tint / tint.mean() - 1))
    return LightChange(*factors)
