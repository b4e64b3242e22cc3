"""Rendering an articulated object with SAPIEN: kinematic playback, several cameras, labels per pixel.

Links are placed by our own forward kinematics; no physics is stepped. Every entity that has meshes
of its own (handles, knobs) is a separate scene entity, so that the segmentation image tells it apart.

Use one renderer per process and keep it: the first picture of a process compiles shaders, which takes
about twenty seconds in software.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from quest.errors import RendererError
from quest.extras import require
from quest.render_device import REMEDY, prepare_renderer
from quest.sim.articulation import Part
from quest.sim.cameras import PosedCamera
from quest.sim.objects import SimObject
from quest.sim.surfaces import ensure_uv

if TYPE_CHECKING:
    import sapien

# x forward, y left, z up (SAPIEN) seen from x right, y down, z forward (OpenCV).
_CV_FROM_SAPIEN = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]], dtype=float)

Dress = Callable[["sapien.Scene", list[Any]], None]
"""Gives a scene its lights, surroundings and materials; gets the scene and the object's render bodies."""


@dataclass(frozen=True)
class Picture:
    """What one camera sees at one moment.

    Attributes:
        rgb: colours.
        depth_m: depth along +z in metres, 0 where nothing is.
        body: 0 background, else 1 + body index.
        entity: 0 nothing, else 1 + entity index; only entities that have meshes of their own.
    """

    rgb: UInt8[np.ndarray, "H W 3"]
    depth_m: Float32[np.ndarray, "H W"]
    body: UInt8[np.ndarray, "H W"]
    entity: UInt8[np.ndarray, "H W"]


class Renderer:
    """SAPIEN's renderer, set up once per process.

    Raises:
        RendererError: no device can render; the message says what to install.
        MissingExtraError: SAPIEN is not installed.
    """

    def __init__(self) -> None:
        self.device = prepare_renderer()
        sapien = require("sapien")
        sapien.render.set_log_level("error")
        self._sapien = sapien
        # SAPIEN drops its compiled shaders with the last camera: keep a stage alive until the next one exists.
        self._latest: Stage | None = None

    def stage(self, sim_object: SimObject, cameras: Sequence[PosedCamera], dress: Dress) -> Stage:
        """A scene with one object and its cameras.

        Args:
            sim_object: the object; body and entity indices in the pictures are its own.
            cameras: where to look from; they stay where they are.
            dress: gives the scene lights, surroundings and materials.
        """
        try:
            self._latest = Stage(self._sapien, sim_object, cameras, dress)
            return self._latest
        except RuntimeError as error:
            raise RendererError(
                f"{sim_object.object_id}: SAPIEN cannot set up the scene ({error}); {REMEDY}"
            ) from error


class Stage:
    """A scene with one object that can be posed and photographed; made by :meth:`Renderer.stage`."""

    def __init__(self, sapien: Any, sim_object: SimObject, cameras: Sequence[PosedCamera], dress: Dress) -> None:
        self._sapien = sapien
        self._scene = sapien.Scene([sapien.render.RenderSystem()])
        self._bodies: list[list[Any]] = [[] for _ in sim_object.articulation.body_names]
        labels: dict[int, tuple[int, int]] = {}
        render_bodies = []
        for body, entity, parts in _groups(sim_object):
            component = sapien.render.RenderBodyComponent()
            for part in parts:
                component.attach(_shape(sapien, part))
            actor = sapien.Entity()
            actor.add_component(component)
            self._scene.add_entity(actor)
            self._bodies[body].append(actor)
            labels[actor.per_scene_id] = (1 + body, 1 + entity)
            render_bodies.append(component)
        dress(self._scene, render_bodies)
        self._label_of_id = np.zeros((max(labels) + 1, 2), dtype=np.uint8)
        for per_scene_id, label in labels.items():
            self._label_of_id[per_scene_id] = label
        self._cameras = [self._add_camera(camera) for camera in cameras]
        self._posed: list[np.ndarray | None] = [None] * len(self._bodies)

    def _add_camera(self, posed: PosedCamera) -> Any:
        camera = posed.camera
        component = self._sapien.render.RenderCameraComponent(camera.width, camera.height)
        far = 1e3
        near = 1e-2 * max(float(np.linalg.norm(posed.cam_from_world[:3, 3])), 1e-2)
        component.set_perspective_parameters(near, far, camera.fx, camera.fy, camera.cx, camera.cy, 0.0)
        mount = self._sapien.Entity()
        mount.add_component(component)
        mount.set_pose(self._sapien.Pose(np.linalg.inv(posed.cam_from_world) @ _CV_FROM_SAPIEN))
        self._scene.add_entity(mount)
        return component

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
        self._scene.update_render()
        for camera in self._cameras:
            camera.take_picture()
        return [self._picture(camera) for camera in self._cameras]

    def _picture(self, camera: Any) -> Picture:
        rgb = np.clip(camera.get_picture("Color")[..., :3] * 255 + 0.5, 0, 255).astype(np.uint8)
        # Camera space with OpenGL axes: depth is -z, and 0 where nothing was drawn.
        depth = np.maximum(-camera.get_picture("Position")[..., 2], 0.0).astype(np.float32)
        ids: Int[np.ndarray, "H W"] = camera.get_picture("Segmentation")[..., 1].astype(np.int64)
        known = ids < len(self._label_of_id)
        labels = self._label_of_id[np.where(known, ids, 0)]
        labels[~known] = 0
        return Picture(rgb, depth, labels[..., 0], labels[..., 1])


def _groups(sim_object: SimObject) -> list[tuple[int, int, list[Part]]]:
    """Body, entity (-1: none) and parts of every scene entity."""
    parts = sim_object.articulation.parts
    owner = {i: e for e, entity in enumerate(sim_object.entities) for i in entity.parts}
    groups: dict[tuple[int, int], list[Part]] = {}
    for i, part in enumerate(parts):
        groups.setdefault((part.body, owner.get(i, -1)), []).append(part)
    return [(body, entity, members) for (body, entity), members in groups.items()]


def _shape(sapien: Any, part: Part) -> Any:
    render = sapien.render
    if part.mesh is not None:
        try:
            shape = render.RenderShapeTriangleMesh(str(part.mesh), np.array(part.scale, dtype=np.float32))
            shape.set_local_pose(sapien.Pose(part.body_from_part))
            shape.set_name(part.name)
            # SAPIEN shares meshes between scenes, and once drawn they no longer take texture coordinates.
            for piece in shape.parts:
                ensure_uv(piece, np.array(part.scale))
            return shape
        except RuntimeError:
            pass  # a file that trimesh reads and assimp refuses; its geometry is known
    corners = np.asarray(part.surface.triangles, dtype=np.float32).reshape(-1, 3)
    normals = np.repeat(np.asarray(part.surface.face_normals, dtype=np.float32), 3, axis=0)
    material = render.RenderMaterial()
    material.set_base_color(part.rgba or (0.7, 0.7, 0.7, 1.0))
    material.set_roughness(0.6)
    faces = np.arange(len(corners), dtype=np.uint32).reshape(-1, 3)
    shape = render.RenderShapeTriangleMesh(corners, faces, normals, np.zeros((len(corners), 2), np.float32), material)
    shape.set_name(part.name)
    return shape
