"""Training windows: an anchor frame and T later or earlier frames of the same view, with their truth."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from quest.errors import ConfigError
from quest.geometry import transform
from quest.model.encoder import EncoderConfig
from quest.model.frames import FrameBatch, reference_of
from quest.train.feature_cache import DEPTH_UNIT_M, CachedView
from quest.train.settings import WindowConfig


@runtime_checkable
class WindowShape(Protocol):
    """What a network's windows are like."""

    @property
    def encoder(self) -> EncoderConfig:
        """Of the encoder, whose input frames are letterboxed to."""
        ...

    @property
    def window(self) -> int:
        """T, frames of a window."""
        ...

    @property
    def cell_px(self) -> int:
        """Side of the cells over which the reference frame takes its median, pixels of the input."""
        ...


@dataclass(frozen=True)
class WindowPlan:
    """Which windows a batch is made of, all that is random about them drawn and nothing large read.

    It is drawn for the whole batch from one generator, and can then be divided among processes and micro-batches, which
    together have exactly the windows, the padding and the disturbances that one process would have had.
    """

    picks: tuple[tuple[CachedView, list[int]], ...]
    """A view and frames of it per window: the anchor first, then the window, oldest first."""
    following: tuple[int, ...]
    """The frame after the window at the step of its newest frames; -1 where the view has none."""
    entities: int
    """Entities of the fullest view of the whole batch, to which all windows are padded."""
    no_depth: Bool[np.ndarray, " B"]
    """Windows that lose all depth."""

    def __len__(self) -> int:
        return len(self.picks)

    def part(self, windows: slice) -> WindowPlan:
        """Some of the windows, padded and disturbed as in the whole."""
        own = {name: getattr(self, name)[windows] for name in ("picks", "following", "no_depth")}
        return replace(self, **own)


@dataclass(frozen=True)
class WindowTruth:
    """What is true of a batch of windows; index 0 of the time axis is the anchor frame."""

    uv: Float[Tensor, "B S K 2"]
    """True coordinates in [0, 1]^2 of the input, also where occluded; NaN behind the camera."""
    visible: Bool[Tensor, "B S K"]
    """Whether the entity is seen."""
    point: Float[Tensor, "B S K 3"]
    """True position in the reference frame."""
    exists: Bool[Tensor, "B K"]
    """False for padding."""
    label: Int[Tensor, "B K"]
    """Index into LABELS."""
    unit: Float[Tensor, " B"]
    """Reference units per normalised unit."""
    revolute: Bool[Tensor, "B K"]
    """Whether the entity's joint turns."""
    axis: Float[Tensor, "B K 6"]
    """Origin and direction of its joint's axis in the reference frame."""
    flow: Float[Tensor, "B K 3"]
    """True displacement from the newest frame to the one after it, reference units. After it means at the window's own
    step between frames, back in time for a window that runs backwards; NaN where the view ends."""

    def to(self, device: torch.device) -> WindowTruth:
        """The same on a device."""
        return WindowTruth(**{f.name: getattr(self, f.name).to(device) for f in fields(self)})


class WindowSampler:
    """Draws batches of windows from prepared views.

    Args:
        views: prepared views, drawn evenly: an object counts as often as it was filmed.
        shape: what the network's windows are like.
        config: how windows are drawn.

    Raises:
        ConfigError: nothing is visible in any view.
    """

    def __init__(self, views: list[CachedView], shape: WindowShape, config: WindowConfig) -> None:
        self.shape = shape
        self.config = config
        self.views = [view for view in views if view.visible.any()]
        if not self.views:
            raise ConfigError(f"training: no entity is visible in any of {len(views)} views; use other takes")

    def draw(self, rng: np.random.Generator, *, disturb: bool = True) -> tuple[FrameBatch, WindowTruth]:
        """One batch; ``disturb`` lets windows lose their depth."""
        return self.load(self.plan(rng, disturb=disturb))

    def plan(self, rng: np.random.Generator, *, disturb: bool = True) -> WindowPlan:
        """The windows of one batch, all that is random about them drawn and nothing large read."""
        chosen = [self._pick(self.views[rng.integers(len(self.views))], rng) for _ in range(self.config.batch)]
        return WindowPlan(
            picks=tuple((view, frames) for view, frames, _ in chosen),
            following=tuple(following for *_, following in chosen),
            entities=max(view.visible.shape[1] for view, *_ in chosen),
            no_depth=rng.random(len(chosen)) < (self.config.depth_drop_share if disturb else 0),
        )

    def load(self, plan: WindowPlan) -> tuple[FrameBatch, WindowTruth]:
        """Read what a plan, or a part of one, names."""
        frames = self._frames(plan)
        return frames, self._truth(plan, frames)

    def _pick(self, view: CachedView, rng: np.random.Generator) -> tuple[CachedView, list[int], int]:
        """A view, its frames (the anchor first, then the window, oldest first), and the frame after them or -1."""
        seen = np.flatnonzero(view.visible.any(axis=1))
        if rng.random() < self.config.first_frame_share:
            anchor = int(view.visible[: max(1, len(view) // 4)].sum(axis=1).argmax())
            anchor = anchor if view.visible[anchor].any() else int(seen[0])
        else:
            anchor = int(rng.choice(seen))
        stride = int(rng.integers(0, self.config.max_stride + 1)) * (1 if rng.random() < 0.5 else -1)
        end = int(rng.integers(len(view)))
        window = [int(np.clip(end - stride * back, 0, len(view) - 1)) for back in range(self.shape.window)]
        # A window whose newest step is cut short by an end of the view says nothing of what its next step would be.
        around = (end + stride,) if self.shape.window == 1 else (end - stride, end + stride)
        following = end + stride if all(0 <= t < len(view) for t in around) else -1
        return view, [anchor, *reversed(window)], following

    def _frames(self, plan: WindowPlan) -> FrameBatch:
        def gather(name: str) -> np.ndarray:
            return np.stack([getattr(view, name)[index] for view, index in plan.picks])

        depth_m = torch.from_numpy(gather("depth").astype(np.float32) * DEPTH_UNIT_M)
        depth_m[torch.from_numpy(plan.no_depth)] = 0
        cameras = [view.camera for view, _ in plan.picks]
        intrinsics = torch.tensor([[c.fx, c.fy, c.cx, c.cy] for c in cameras], dtype=torch.float32)
        poses = torch.from_numpy(gather("cam_from_world")).double()
        center, scale = reference_of(depth_m[:, 0], intrinsics, cell_px=self.shape.cell_px)
        return FrameBatch(
            features=torch.from_numpy(gather("features")).float(),
            depth_m=depth_m,
            intrinsics=intrinsics,
            ref_from_cam=(poses[:, :1] @ torch.linalg.inv(poses)).float(),
            center=center,
            scale=scale,
        )

    def _truth(self, plan: WindowPlan, frames: FrameBatch) -> WindowTruth:
        picks, b, most = plan.picks, len(plan), plan.entities

        def padded(name: str, *, per_frame: bool) -> Tensor:
            sample = [getattr(v, name)[i] if per_frame else getattr(v, name) for v, i in picks]
            axis = 1 if per_frame else 0
            shape = list(sample[0].shape)
            shape[axis] = most
            out = np.zeros((b, *shape), sample[0].dtype)
            for i, array in enumerate(sample):
                out[(i, *(slice(None),) * axis, slice(0, array.shape[axis]))] = array
            return torch.from_numpy(out)

        exists = torch.tensor([[k < view.visible.shape[1] for k in range(most)] for view, _ in picks])
        axis = padded("axis_world", per_frame=False)
        ref_from_world = torch.from_numpy(np.stack([v.cam_from_world[i[0]] for v, i in picks])).float()
        center, scale = frames.center[:, None], frames.scale[:, None, None]
        point = transform(ref_from_world[:, None, None], padded("point_world", per_frame=True))
        origin = (transform(ref_from_world[:, None], axis[..., :3]) - center) / scale
        direction = (ref_from_world[:, None, :3, :3] @ axis[..., 3:, None]).squeeze(-1)
        half = torch.tensor([view.half_diagonal_m for view, _ in picks], dtype=torch.float32)
        return WindowTruth(
            uv=padded("uv_px", per_frame=True) / self.shape.encoder.image_size,
            visible=padded("visible", per_frame=True),
            point=(point - center[:, None]) / scale[:, None],
            exists=exists,
            label=padded("label", per_frame=False).long(),
            unit=half / frames.scale,
            revolute=padded("revolute", per_frame=False),
            axis=torch.cat((origin, direction), dim=-1),
            flow=_flow(plan, ref_from_world) / scale,
        )


def _flow(plan: WindowPlan, ref_from_world: Float[Tensor, "B 4 4"]) -> Float[Tensor, "B K 3"]:
    """Displacements to the frame after each window in the reference axes, metres."""
    out = np.full((len(plan), plan.entities, 3), np.nan, np.float32)
    for i, ((view, frames), following) in enumerate(zip(plan.picks, plan.following, strict=True)):
        if following >= 0:
            out[i, : view.visible.shape[1]] = view.point_world[following] - view.point_world[frames[-1]]
    return (ref_from_world[:, None, :3, :3] @ torch.from_numpy(out).unsqueeze(-1)).squeeze(-1)
