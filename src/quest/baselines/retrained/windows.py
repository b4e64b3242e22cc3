"""Points of takes whose way through a few frames is known exactly: every pixel shows a link whose pose is known."""

from __future__ import annotations

import json
import os
import shutil
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int, UInt8, UInt16
from torch import Tensor, nn

from quest.data.store import TakeStore
from quest.errors import ConfigError
from quest.geometry.letterbox import Letterbox
from quest.model.config import StoredConfig
from quest.types import Camera, Take

_DEPTH_UNIT_M = 1e-3
_SAME_SHARE, _SAME_M = 0.02, 0.01
"""Depth that differs from a point's by no more than this shows the point."""
_REST = 1e-3
"""Poses that differ by no more than this, in metres or in their rotations, are of what rests."""
_MOST = 4096
"""Of anything in a network's shapes."""
_BEYOND_PX = 32.0
"""Points farther outside the picture than this teach nothing."""


@dataclass(frozen=True, kw_only=True)
class ShownConfig(StoredConfig):
    """Shapes of a network: what it is shown."""

    image_size: int = 224
    """Side of the canvas that frames are letterboxed to, pixels."""
    frames: int
    """Of a window to learn from."""

    def __post_init__(self) -> None:
        if not all(1 <= value <= _MOST for value in vars(self).values()):
            raise ConfigError(f"network: expected sizes and counts from 1 to {_MOST}, got {self}")


@dataclass(frozen=True)
class PointConfig:
    """How windows are drawn."""

    batch: int = 4
    """Windows of a step."""
    points: int = 32
    frames: int = 8
    """Of every window."""
    max_stride: int = 3
    """Largest step between its frames, in stored frames."""


@dataclass(frozen=True)
class FilmedView:
    """One view of a take on the canvas; pixels are opened as memory maps."""

    folder: Path
    camera: Camera
    """Of the canvas."""

    @property
    def rgb(self) -> UInt8[np.ndarray, "T S S 3"]:
        """Colours."""
        return self._map("rgb")

    @property
    def depth(self) -> UInt16[np.ndarray, "T S S"]:
        """Millimetres, 0 where missing."""
        return self._map("depth")

    @property
    def link(self) -> UInt8[np.ndarray, "T S S"]:
        """0 for what stands still for ever, else 1 + the index of a link."""
        return self._map("link")

    @property
    def cam_from_world(self) -> Float32[np.ndarray, "T 4 4"]:
        """Of every frame."""
        return self._map("cam_from_world")

    @property
    def link_pose(self) -> Float32[np.ndarray, "T L 4 4"]:
        """Of every link in the world."""
        return self._map("link_pose")

    def _map(self, name: str) -> np.ndarray:
        return np.load(self.folder / f"{name}.npy", mmap_mode="r", allow_pickle=False)


@dataclass(frozen=True)
class PointWindow:
    """What a network is shown: frames, and pixels of points in the first of them."""

    rgb: UInt8[Tensor, "B S H W 3"]
    depth_m: Float[Tensor, "B S H W"]
    """0 where missing."""
    intrinsics: Float[Tensor, "B 4"]
    """fx, fy, cx, cy of the canvas, pixels; centres at half-integers."""
    uv_px: Float[Tensor, "B N 2"]
    """Points of the first frame."""

    def to(self, device: torch.device) -> PointWindow:
        """The same on a device."""
        return PointWindow(*(getattr(self, f.name).to(device) for f in fields(self)))


@dataclass(frozen=True)
class PointTruth:
    """Where the points are in every frame."""

    uv_px: Float[Tensor, "B S N 2"]
    """Also where occluded."""
    visible: Bool[Tensor, "B S N"]
    """Whether they are seen."""
    known: Bool[Tensor, "B S N"]
    """In front of the camera and in the picture, or close beside it."""

    def to(self, device: torch.device) -> PointTruth:
        """The same on a device."""
        return PointTruth(*(getattr(self, f.name).to(device) for f in fields(self)))


class PointNetwork(nn.Module):
    """A network that follows the points of a window's first frame."""

    config: ShownConfig

    @abstractmethod
    def follow(self, window: PointWindow) -> tuple[Float[Tensor, "B S N 2"], Float[Tensor, "B S N"]]:
        """Where they are in every frame, pixels of the canvas, and log odds that they are seen."""

    @abstractmethod
    def losses(self, window: PointWindow, truth: PointTruth) -> dict[str, Float[Tensor, ""]]:
        """What it learns by, unweighted."""


@dataclass(frozen=True)
class PointPlan:
    """Windows of a batch, all that is random about them drawn."""

    views: tuple[FilmedView, ...]
    """Of every window."""
    frames: Int[np.ndarray, "B S"]
    """Of its view."""
    seeds: Int[np.ndarray, " B"]
    """Of its points and colours."""
    disturb: bool
    """Whether colours change and pictures are mirrored."""

    def part(self, rows: slice) -> PointPlan:
        """Some of the windows."""
        return PointPlan(self.views[rows], self.frames[rows], self.seeds[rows], self.disturb)


def film(store: TakeStore, names: Sequence[str], folder: Path, *, size: int) -> list[FilmedView]:
    """All views of some takes on canvases of a side, made where missing, each whole or not at all."""
    return [view for name in names for view in _filmed(store, name, folder, size)]


def _filmed(store: TakeStore, name: str, folder: Path, size: int) -> Iterator[FilmedView]:
    entry = folder / f"{name}-{size}-{store.data_hash(name)[:12]}"
    if not entry.exists():
        partial = entry.with_name(f".partial-{entry.name}.{os.getpid()}")
        shutil.rmtree(partial, ignore_errors=True)
        take = store.read(name)
        for view in range(len(take.views)):
            _write(take, view, partial / f"v{view}", size)
        try:
            partial.rename(entry)
        except OSError:  # another process has just made it
            if not entry.exists():
                raise
            shutil.rmtree(partial)
    for each in sorted(entry.iterdir()):
        yield FilmedView(each, Camera(**json.loads((each / "camera.json").read_text())))


def _write(take: Take, view: int, folder: Path, size: int) -> None:
    shown = take.views[view]
    clip, box = shown.clip, Letterbox(shown.clip.camera, size)
    if clip.depth_m is None:
        raise ConfigError(f"take {take.info.name!r}: expected depth, by which points are known; generate it with depth")
    arrays = {
        "rgb": np.stack([box.rgb(image) for image in clip.rgb]),
        "depth": np.stack([box.depth(d) / _DEPTH_UNIT_M for d in clip.depth_m]).clip(0, 65535).astype(np.uint16),
        "link": np.stack([box.depth(ids.astype(np.float32)) for ids in shown.link_id]).astype(np.uint8),
        "cam_from_world": clip.cam_from_world.astype(np.float32),
        "link_pose": take.link_pose,
    }
    folder.mkdir(parents=True)
    for name, array in arrays.items():
        np.save(folder / f"{name}.npy", array, allow_pickle=False)
    (folder / "camera.json").write_text(json.dumps(asdict(box.camera)))


class PointSampler:
    """Windows of views, for :func:`quest.train.loop.fit`."""

    def __init__(self, views: Sequence[FilmedView], config: PointConfig) -> None:
        self.views, self.config = tuple(views), config

    def plan(self, rng: np.random.Generator, *, disturb: bool = True) -> PointPlan:
        """Any view, any first frame, and later or earlier ones in even steps; beyond its ends a view stands still."""
        c = self.config
        views = tuple(self.views[i] for i in rng.integers(len(self.views), size=c.batch))
        lengths = np.array([len(view.cam_from_world) for view in views])
        step = rng.integers(1, c.max_stride + 1, c.batch) * rng.choice((-1, 1), c.batch)
        first = (rng.random(c.batch) * lengths).astype(int)
        frames = np.clip(first[:, None] + step[:, None] * np.arange(c.frames), 0, lengths[:, None] - 1)
        return PointPlan(views, frames, rng.integers(2**62, size=c.batch), disturb)

    def load(self, plan: PointPlan) -> tuple[PointWindow, PointTruth]:
        """The frames, and the way of points through them."""
        rows = [self._window(*row, plan.disturb) for row in zip(plan.views, plan.frames, plan.seeds, strict=True)]
        inputs, truths = zip(*rows, strict=True)
        return (
            PointWindow(*(torch.from_numpy(np.stack(part)) for part in zip(*inputs, strict=True))),
            PointTruth(*(torch.from_numpy(np.stack(part)) for part in zip(*truths, strict=True))),
        )

    def _window(
        self, view: FilmedView, frames: Int[np.ndarray, " S"], seed: np.int64, disturb: bool
    ) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
        rng, camera = np.random.default_rng(int(seed)), view.camera
        rgb, link = view.rgb[frames], view.link[frames]
        depth_m = view.depth[frames] * np.float32(_DEPTH_UNIT_M)
        pose = view.link_pose[frames]
        moves = 1 + np.flatnonzero(abs(pose - pose[:1]).max(axis=(0, 2, 3)) > _REST)
        pixel = _draw(rng, link[0], depth_m[0], moves, self.config.points)
        uv, visible, known = follow_pixels(pixel, link, depth_m, camera, view.cam_from_world[frames], pose)
        intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
        if disturb:
            gain, offset = rng.uniform(0.7, 1.3, 3), rng.uniform(-25, 25, 3)
            rgb = np.clip(rgb * gain + offset, 0, 255).astype(np.uint8)
            if rng.random() < 0.5:
                rgb, depth_m = rgb[:, :, ::-1], depth_m[:, :, ::-1]
                uv[..., 0], intrinsics[2] = camera.width - uv[..., 0], camera.width - intrinsics[2]
        inputs = (np.ascontiguousarray(rgb), np.ascontiguousarray(depth_m), intrinsics, uv[0].copy())
        return inputs, (uv, visible, known)


def _draw(
    rng: np.random.Generator,
    link: UInt8[np.ndarray, "H W"],
    depth_m: Float32[np.ndarray, "H W"],
    moves: Int[np.ndarray, " M"],
    count: int,
) -> Int[np.ndarray, "N 2"]:
    """Columns and rows of pixels with depth: half of them anywhere, half on links that move, as far as any is seen."""
    row, column = np.nonzero(depth_m > 0)
    if not len(row):
        raise ConfigError("training: a frame has no depth at all; leave its take out")
    chosen, moving = rng.integers(len(row), size=count), np.flatnonzero(np.isin(link[row, column], moves))
    if len(moving):
        chosen[: count // 2] = rng.choice(moving, count // 2)
    return np.stack((column[chosen], row[chosen]), axis=-1)


def follow_pixels(
    pixel: Int[np.ndarray, "N 2"],
    link: UInt8[np.ndarray, "S H W"],
    depth_m: Float32[np.ndarray, "S H W"],
    camera: Camera,
    cam_from_world: Float32[np.ndarray, "S 4 4"],
    link_pose: Float32[np.ndarray, "S L 4 4"],
) -> tuple[Float32[np.ndarray, "S N 2"], Bool[np.ndarray, "S N"], Bool[np.ndarray, "S N"]]:
    """Where the surfaces in pixels (column, row) of the first frame are in every frame.

    Returns:
        Pixels with centres at half-integers; whether each is seen: the same link is there, at the depth of the point;
        whether it is in front of the camera and in the picture or close beside it.
    """
    column, row = pixel.T
    of = link[0, row, column].astype(int)
    focal, middle = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    z = depth_m[0, row, column].astype(np.float64)
    in_cam = np.column_stack(((pixel + 0.5 - middle) / focal * z[:, None], z, np.ones_like(z)))
    still = np.broadcast_to(np.eye(4), (len(link), 1, 4, 4))
    body = np.concatenate((still, link_pose), axis=1)[:, of]
    first = np.linalg.inv(body[0]) @ np.linalg.inv(cam_from_world[0].astype(np.float64))
    point = (cam_from_world[:, None] @ body @ first @ in_cam[..., None])[..., 0]
    ahead = point[..., 2] > 0.01
    depth = np.where(ahead, point[..., 2], 1.0)
    uv = point[..., :2] / depth[..., None] * focal + middle
    size = np.array([camera.width, camera.height])
    inside = ahead & ((uv >= 0) & (uv < size)).all(axis=-1)
    known = ahead & ((uv > -_BEYOND_PX) & (uv < size + _BEYOND_PX)).all(axis=-1)
    at = np.where(inside[..., None], uv, 0).astype(int)
    each = np.arange(len(link))[:, None]
    shown_m = depth_m[each, at[..., 1], at[..., 0]]
    same = (link[each, at[..., 1], at[..., 0]] == of) & (abs(shown_m - depth) < _SAME_SHARE * depth + _SAME_M)
    return uv.astype(np.float32), inside & same, known
