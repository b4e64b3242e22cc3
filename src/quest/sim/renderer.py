"""Rendering an articulated object with SAPIEN: kinematic playback, several cameras, labels per pixel.

Links are placed by our own forward kinematics; no physics is stepped. Every entity that has meshes
of its own (handles, knobs) is a separate scene entity, so that the segmentation image tells it apart.

The first picture of a process compiles shaders, which takes about twenty seconds in software.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from jaxtyping import Float, Float32, UInt8

from quest.errors import RendererError
from quest.extras import require
from quest.render_device import REMEDY, prepare_renderer, without_known_warnings
from quest.sim.articulation import Part
from quest.sim.cameras import PosedCamera
from quest.sim.objects import SimObject
from quest.sim.surfaces import ensure_uv
from quest.sim.urdf import MeshData

if TYPE_CHECKING:
    import sapien

# x forward, y left, z up (SAPIEN) seen from x right, y down, z forward (OpenCV).
_CV_FROM_SAPIEN = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]], dtype=float)

Dress = Callable[["sapien.Scene", list[Any]], None]
"""Gives a scene its lights, surroundings and materials; gets the scene and the object's render bodies."""


@dataclass(frozen=True)
class Picture:
    """What one camera sees at one moment."""

    rgb: UInt8[np.ndarray, "H W 3"]
    """Colours."""
    depth_m: Float32[np.ndarray, "H W"]
    """Depth along +z in metres, 0 where nothing is."""
    body: UInt8[np.ndarray, "H W"]
    """0 background, else 1 + body index."""
    entity: UInt8[np.ndarray, "H W"]
    """0 nothing, else 1 + entity index; only entities that have meshes of their own."""


class Renderer:
    """SAPIEN's renderer; what it compiles serves all renderers of a process.

    Raises:
        RendererError: no device can render; the message says what to install.
        MissingExtraError: SAPIEN is not installed.
    """

    _latest: ClassVar[Stage | None] = None
    """Kept alive until the next one exists, because SAPIEN drops its compiled shaders with the last camera."""

    def __init__(self) -> None:
        self.device = prepare_renderer()
        sapien = require("sapien")
        sapien.render.set_log_level("error")
        self._sapien = sapien

    def stage(self, sim_object: SimObject, cameras: Sequence[PosedCamera], dress: Dress | None = None) -> Stage:
        """A scene with one object and its cameras.

        Args:
            sim_object: the object; body and entity indices in the pictures are its own.
            cameras: where to look from, until :meth:`Stage.aim` says otherwise.
            dress: gives the scene lights, surroundings and materials; without it the scene is dark until
                :meth:`Stage.dress`, which is enough for depth and labels.
        """
        try:
            with nullcontext() if Renderer._latest is not None else without_known_warnings():
                stage = Renderer._latest = Stage(self._sapien, sim_object, cameras)
            if dress is not None:
                stage.dress(dress)
            return stage
        except RuntimeError as error:
            raise RendererError(
                f"{sim_object.object_id}: SAPIEN cannot set up the scene ({error}); {REMEDY}"
            ) from error


class Stage:
    """A scene with one object that can be posed and photographed; made by :meth:`Renderer.stage`."""

    def __init__(self, sapien: Any, sim_object: SimObject, cameras: Sequence[PosedCamera]) -> None:
        self._sapien = sapien
        self._scene = sapien.Scene([sapien.render.RenderSystem()])
        self._bodies: list[list[Any]] = [[] for _ in sim_object.articulation.body_names]
        labels: dict[int, tuple[int, int]] = {}
        self._render_bodies: list[Any] = []
        for body, entity, parts in _groups(sim_object):
            component = sapien.render.RenderBodyComponent()
            for part in parts:
                for shape in _shapes(sapien, part):
                    component.attach(shape)
            actor = sapien.Entity()
            actor.add_component(component)
            self._scene.add_entity(actor)
            self._bodies[body].append(actor)
            labels[actor.per_scene_id] = (1 + body, 1 + entity)
            self._render_bodies.append(component)
        self._body_of_id = np.zeros(max(labels) + 2, dtype=np.uint8)
        self._entity_of_id = np.zeros(max(labels) + 2, dtype=np.uint8)
        for per_scene_id, (body, entity) in labels.items():
            self._body_of_id[per_scene_id], self._entity_of_id[per_scene_id] = body, entity
        self._posed: list[np.ndarray | None] = [None] * len(self._bodies)
        self._cameras = [self._add_camera(posed) for posed in cameras]
        self._aimed: list[PosedCamera | None] = [None] * len(self._cameras)
        self.aim(cameras)

    def dress(self, dress: Dress) -> None:
        """Gives the scene its lights, surroundings and materials."""
        dress(self._scene, self._render_bodies)

    def _add_camera(self, posed: PosedCamera) -> tuple[Any, Any]:
        component = self._sapien.render.RenderCameraComponent(posed.camera.width, posed.camera.height)
        mount = self._sapien.Entity()
        mount.add_component(component)
        self._scene.add_entity(mount)
        return component, mount

    def aim(self, cameras: Sequence[PosedCamera]) -> None:
        """Moves the cameras; their number and image sizes stay."""
        for index, posed in enumerate(cameras):
            last, (component, mount) = self._aimed[index], self._cameras[index]
            if last is None or last.camera != posed.camera:
                camera = posed.camera
                near = 1e-2 * max(float(np.linalg.norm(posed.cam_from_world[:3, 3])), 1e-2)
                component.set_perspective_parameters(near, 1e3, camera.fx, camera.fy, camera.cx, camera.cy, 0.0)
            if last is None or not np.array_equal(last.cam_from_world, posed.cam_from_world):
                mount.set_pose(self._sapien.Pose(np.linalg.inv(posed.cam_from_world) @ _CV_FROM_SAPIEN))
            self._aimed[index] = posed

    def pose(self, world_from_body: Float[np.ndarray, "B 4 4"]) -> None:
        """Moves the bodies."""
        for b, matrix in enumerate(world_from_body):
            last = self._posed[b]
            if last is not None and np.array_equal(last, matrix):
                continue
            pose = self._sapien.Pose(matrix)
            for actor in self._bodies[b]:
                actor.set_pose(pose)
            self._posed[b] = matrix.copy()

    def pictures(self) -> list[Picture]:
        """What every camera sees now."""
        self.shoot()
        return self.develop()

    def shoot(self) -> None:
        """Begins to draw what every camera sees now, and does not wait for it."""
        self._scene.update_render()
        for camera, _ in self._cameras:
            camera.take_picture()

    def develop(self) -> list[Picture]:
        """The pictures of the last :meth:`shoot`, when they are drawn."""
        return [self._picture(camera) for camera, _ in self._cameras]

    def _picture(self, camera: Any) -> Picture:
        colour = camera.get_picture("Color")[..., :3] * np.float32(255)
        colour += np.float32(0.5)
        rgb = np.clip(colour, 0, 255, out=colour).astype(np.uint8)
        # Camera space with OpenGL axes: depth is -z, and 0 where nothing was drawn.
        depth = np.maximum(-camera.get_picture("Position")[..., 2], 0.0).astype(np.float32)
        # Whatever was added after the object (props, surroundings) shares the last entry: background.
        ids = np.minimum(camera.get_picture("Segmentation")[..., 1], len(self._body_of_id) - 1)
        return Picture(rgb, depth, self._body_of_id.take(ids), self._entity_of_id.take(ids))


def _groups(sim_object: SimObject) -> list[tuple[int, int, list[Part]]]:
    """Body, entity (-1: none) and parts of every scene entity."""
    parts = sim_object.articulation.parts
    owner = {i: e for e, entity in enumerate(sim_object.entities) for i in entity.parts}
    groups: dict[tuple[int, int], list[Part]] = {}
    for i, part in enumerate(parts):
        groups.setdefault((part.body, owner.get(i, -1)), []).append(part)
    return [(body, entity, members) for (body, entity), members in groups.items()]


def _shapes(sapien: Any, part: Part) -> list[Any]:
    # SAPIEN shares meshes between scenes, and once drawn they no longer take texture coordinates: they get them here.
    if part.mesh is not None:
        try:
            shape = _mesh_shape(sapien, part)
        except RuntimeError:
            pass  # a file that trimesh reads and assimp refuses; its geometry is known
        else:
            for piece in shape.parts:
                ensure_uv(piece, np.array(part.uv_scale))
                if part.rgba is not None and piece.material.base_color_texture is None:
                    piece.material.set_base_color(part.rgba)
            return [shape] if np.prod(part.scale) > 0 else [_mirrored(sapien, piece, part) for piece in shape.parts]
    corners = np.asarray(part.surface.triangles, dtype=np.float32).reshape(-1, 3)
    normals = np.repeat(np.asarray(part.surface.face_normals, dtype=np.float32), 3, axis=0)
    no_uv = np.zeros((len(corners), 2), np.float32)
    shape = _triangles(sapien, (corners, normals, no_uv), part.rgba or (0.7, 0.7, 0.7, 1.0), roughness=0.6)
    shape.set_name(part.name)
    for piece in shape.parts:
        ensure_uv(piece, np.ones(3))
    return [shape]


def _mesh_shape(sapien: Any, part: Part) -> Any:
    """A part's own mesh with its name, scale and pose."""
    if isinstance(part.mesh, MeshData):
        look = (*part.mesh.colour, 1.0), part.mesh.roughness
        shape = _triangles(sapien, part.mesh.corners, *look, specular=0.5)  # as SAPIEN gives to mesh files
        shape.set_scale(np.array(part.scale, dtype=np.float32))
    else:
        shape = sapien.render.RenderShapeTriangleMesh(str(part.mesh), np.array(part.scale, dtype=np.float32))
    shape.set_local_pose(sapien.Pose(part.body_from_part))
    shape.set_name(part.name)
    return shape


def _triangles(
    sapien: Any, corners: tuple[np.ndarray, ...], rgba: tuple[float, ...], roughness: float, specular: float = 0.0
) -> Any:
    """Triangles that share no corner, from the position, normal and texture coordinate of every corner."""
    material = sapien.render.RenderMaterial()
    material.set_base_color(rgba)
    material.set_roughness(roughness)
    material.set_specular(specular)
    position, normal, uv = corners
    faces = np.arange(len(position), dtype=np.uint32).reshape(-1, 3)
    return sapien.render.RenderShapeTriangleMesh(position, faces, normal, uv, material)


def _mirrored(sapien: Any, piece: Any, part: Part) -> Any:
    """A piece of a mesh with a negative scale, whose triangles are turned round: what looks away is not drawn."""
    scale = np.array(part.scale, dtype=np.float32)
    normals = piece.get_vertex_normal() / scale
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    triangles = np.ascontiguousarray(piece.get_triangles()[:, ::-1])
    shape = sapien.render.RenderShapeTriangleMesh(
        piece.get_vertices() * scale, triangles, normals, piece.get_vertex_uv(), piece.material
    )
    shape.set_local_pose(sapien.Pose(part.body_from_part))
    shape.set_name(part.name)
    return shape
