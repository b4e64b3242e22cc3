"""Rendering an articulated object with SAPIEN: kinematic playback, several cameras, labels per pixel.

Links are placed by our own forward kinematics; no physics is stepped. Every entity that has meshes
of its own (handles, knobs) is a separate scene entity, so that the segmentation image tells it apart.

The first picture of a process compiles shaders, which takes about twenty seconds in software.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any, ClassVar

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

# x forward, y left, z up (SAPIEN) seen from x right, y down, z forward (OpenCV).
_CV_FROM_SAPIEN = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]], dtype=float)


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

    latest: ClassVar[Stage | None] = None
    """The last stage that was made. Kept until the next one exists, because SAPIEN drops its compiled shaders with the
    last camera."""

    def __init__(self) -> None:
        self.device = prepare_renderer()
        sapien = require("sapien")
        sapien.render.set_log_level("error")
        self._sapien = sapien

    def stage(self, sim_object: SimObject, cameras: Sequence[PosedCamera]) -> Stage:
        """A scene with one object and its cameras; dark, which is enough for depth and labels."""
        try:
            with nullcontext() if Renderer.latest is not None else without_known_warnings():
                stage = Renderer.latest = Stage(self._sapien, sim_object, cameras)
            return stage
        except RuntimeError as error:
            raise RendererError(
                f"{sim_object.object_id}: SAPIEN cannot set up the scene ({error}); {REMEDY}"
            ) from error


class Stage:
    """A scene with one object that can be posed and photographed; made by :meth:`Renderer.stage`.

    Body and entity indices in the pictures are the object's own.
    """

    def __init__(self, sapien: Any, sim_object: SimObject, cameras: Sequence[PosedCamera]) -> None:
        self._sapien = sapien
        self.scene = sapien.Scene([sapien.render.RenderSystem()])
        """The ``sapien.Scene``, for what else shall be in it."""
        self.bodies: list[Any] = []
        """The object's ``RenderBodyComponent``s, always in the same order."""
        self._actors: list[list[Any]] = [[] for _ in sim_object.articulation.body_names]
        owner = {i: 1 + e for e, entity in enumerate(sim_object.entities) for i in entity.parts}
        groups: dict[tuple[int, int], list[Part]] = {}
        for i, part in enumerate(sim_object.articulation.parts):
            groups.setdefault((part.body, owner.get(i, 0)), []).append(part)
        labels: dict[int, tuple[int, int]] = {}
        for (body, entity), parts in groups.items():
            component = sapien.render.RenderBodyComponent()
            for part in parts:
                for shape in _shapes(sapien, part):
                    component.attach(shape)
            actor = self._add(component)
            self._actors[body].append(actor)
            self.bodies.append(component)
            labels[actor.per_scene_id] = (1 + body, entity)
        # Whatever is added after the object (props, surroundings) shares the last entry: background.
        self._labels_of_id = np.zeros((2, max(labels) + 2), dtype=np.uint8)
        for per_scene_id, label in labels.items():
            self._labels_of_id[:, per_scene_id] = label
        self._posed: list[np.ndarray | None] = [None] * len(self._actors)
        self.cameras = [sapien.render.RenderCameraComponent(c.camera.width, c.camera.height) for c in cameras]
        self._mounts = [self._add(camera) for camera in self.cameras]
        self._aimed: list[PosedCamera | None] = [None] * len(self.cameras)
        self.aim(cameras)

    def _add(self, component: Any) -> Any:
        actor = self._sapien.Entity()
        actor.add_component(component)
        self.scene.add_entity(actor)
        return actor

    def aim(self, cameras: Sequence[PosedCamera]) -> None:
        """Moves the cameras; their number and image sizes stay."""
        for index, (posed, last) in enumerate(zip(cameras, self._aimed, strict=True)):
            camera, pose = posed.camera, posed.cam_from_world
            if last is None or last.camera != camera:
                near = 1e-2 * max(float(np.linalg.norm(pose[:3, 3])), 1e-2)
                self.cameras[index].set_perspective_parameters(
                    near, 1e3, camera.fx, camera.fy, camera.cx, camera.cy, 0.0
                )
            if last is None or not np.array_equal(last.cam_from_world, pose):
                self._mounts[index].set_pose(self._sapien.Pose(np.linalg.inv(pose) @ _CV_FROM_SAPIEN))
            self._aimed[index] = posed

    def pose(self, world_from_body: Float[np.ndarray, "B 4 4"]) -> None:
        """Moves the bodies."""
        for b, (matrix, last) in enumerate(zip(world_from_body, self._posed, strict=True)):
            if last is None or not np.array_equal(last, matrix):
                pose = self._sapien.Pose(matrix)
                for actor in self._actors[b]:
                    actor.set_pose(pose)
                self._posed[b] = matrix.copy()

    def pictures(self) -> list[Picture]:
        """What every camera sees now."""
        self.render()
        return self.read_back()

    def render(self) -> None:
        """Begins to draw what every camera sees now, and does not wait for it."""
        self.scene.update_render()
        for camera in self.cameras:
            camera.take_picture()

    def read_back(self) -> list[Picture]:
        """The pictures of the last :meth:`render`, when they are drawn."""
        return [self._picture(camera) for camera in self.cameras]

    def _picture(self, camera: Any) -> Picture:
        colour = camera.get_picture("Color")[..., :3] * np.float32(255)
        colour += np.float32(0.5)
        rgb = np.clip(colour, 0, 255, out=colour).astype(np.uint8)
        # Camera space with OpenGL axes: depth is -z, and 0 where nothing was drawn.
        depth = np.maximum(-camera.get_picture("Position")[..., 2], 0.0).astype(np.float32)
        ids = np.minimum(camera.get_picture("Segmentation")[..., 1], self._labels_of_id.shape[1] - 1)
        body, entity = self._labels_of_id
        return Picture(rgb, depth, body.take(ids), entity.take(ids))


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
    scale = np.array(part.scale, dtype=np.float32)
    if isinstance(part.mesh, MeshData):
        look = (*part.mesh.colour, 1.0), part.mesh.roughness
        shape = _triangles(sapien, part.mesh.corners, *look, specular=0.5)  # as SAPIEN gives to mesh files
        shape.set_scale(scale)
    else:
        shape = sapien.render.RenderShapeTriangleMesh(str(part.mesh), scale)
    return _in_place(sapien, shape, part)


def _in_place(sapien: Any, shape: Any, part: Part) -> Any:
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
    return _in_place(sapien, shape, part)
