"""Training windows: an anchor frame and T later or earlier frames of the same view, with their truth."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from quest.errors import ConfigError
from quest.geometry import transform
from quest.model.config import NetworkConfig
from quest.model.network import UNKNOWN_LABEL
from quest.model.observation import FrameBatch, reference_of
from quest.train.feature_cache import CachedView
from quest.train.settings import WindowConfig

_DEPTH_UNIT_M = 1e-4


@dataclass(frozen=True)
class WindowTruth:
    """What is true of a batch of windows; index 0 of the time axis is the anchor frame.

    Attributes:
        uv: true coordinates in [0, 1]^2 of the input, also where occluded; NaN behind the camera.
        visible: whether the entity is seen.
        point: true position in the reference frame.
        exists: False for padding.
        bound: entities that were seen at the anchor frame and are asked for.
        label: index into LABELS.
        told: label given to the query, or ``len(LABELS)``.
        anchor_uv: disturbed coordinates of the anchor.
        unit: reference units per normalised unit.
        revolute: whether the entity's joint turns.
        axis: origin and direction of its joint's axis in the reference frame.
    """

    uv: Float[Tensor, "B S K 2"]
    visible: Bool[Tensor, "B S K"]
    point: Float[Tensor, "B S K 3"]
    exists: Bool[Tensor, "B K"]
    bound: Bool[Tensor, "B K"]
    label: Int[Tensor, "B K"]
    told: Int[Tensor, "B K"]
    anchor_uv: Float[Tensor, "B K 2"]
    unit: Float[Tensor, " B"]
    revolute: Bool[Tensor, "B K"]
    axis: Float[Tensor, "B K 6"]

    def to(self, device: torch.device) -> WindowTruth:
        """The same on a device."""
        return WindowTruth(**{f.name: getattr(self, f.name).to(device) for f in fields(self)})


class WindowSampler:
    """Draws batches of windows from prepared views.

    Args:
        views: prepared views, drawn evenly: an object counts as often as it was filmed.
        network: network that the windows are for.
        config: how windows are drawn.

    Raises:
        ConfigError: nothing is visible in any view.
    """

    def __init__(self, views: list[CachedView], network: NetworkConfig, config: WindowConfig) -> None:
        self.network = network
        self.config = config
        self.views = [view for view in views if view.visible.any()]
        if not self.views:
            raise ConfigError(f"training: no entity is visible in any of {len(views)} views; use other takes")

    def draw(self, rng: np.random.Generator, *, disturb: bool = True) -> tuple[FrameBatch, WindowTruth]:
        """One batch; ``disturb`` turns on everything that is random beyond the choice of frames."""
        picks = []
        for _ in range(self.config.batch):
            picks.append(self._pick(self.views[rng.integers(len(self.views))], rng))
        frames = self._frames(picks, rng, disturb=disturb)
        return frames, self._truth(picks, frames, rng, disturb=disturb)

    def _pick(self, view: CachedView, rng: np.random.Generator) -> tuple[CachedView, list[int]]:
        """A view and its frames: the anchor first, then the window, oldest first."""
        seen = np.flatnonzero(view.visible.any(axis=1))
        if rng.random() < self.config.first_frame_share:
            anchor = int(view.visible[: max(1, len(view) // 4)].sum(axis=1).argmax())
            anchor = anchor if view.visible[anchor].any() else int(seen[0])
        else:
            anchor = int(rng.choice(seen))
        stride = int(rng.integers(0, self.config.max_stride + 1)) * (1 if rng.random() < 0.5 else -1)
        end = int(rng.integers(len(view)))
        window = [int(np.clip(end - stride * back, 0, len(view) - 1)) for back in range(self.network.window)]
        return view, [anchor, *reversed(window)]

    def _frames(
        self, picks: list[tuple[CachedView, list[int]]], rng: np.random.Generator, *, disturb: bool
    ) -> FrameBatch:
        def gather(name: str) -> np.ndarray:
            return np.stack([getattr(view, name)[index] for view, index in picks])

        depth_m = torch.from_numpy(gather("depth").astype(np.float32) * _DEPTH_UNIT_M)
        cell_depth_m = torch.from_numpy(gather("cell_depth_m"))
        rgb = gather("rgb")
        if disturb:
            dropped = torch.from_numpy(rng.random(len(picks)) < self.config.depth_drop_share)
            depth_m[dropped] = 0
            cell_depth_m[dropped] = 0
            gain = 1 + self.config.colour_jitter * rng.uniform(-1, 1, (len(picks), 1, 1, 1, 3)).astype(np.float32)
            rgb = np.clip(rgb * gain, 0, 255).astype(np.uint8)
        cameras = [view.camera for view, _ in picks]
        intrinsics = torch.tensor([[c.fx, c.fy, c.cx, c.cy] for c in cameras], dtype=torch.float32)
        poses = torch.from_numpy(gather("cam_from_world")).double()
        center, scale = reference_of(cell_depth_m[:, 0], intrinsics, self.network.encoder.image_size)
        return FrameBatch(
            features=torch.from_numpy(gather("features")).float(),
            rgb=torch.from_numpy(rgb),
            depth_m=depth_m,
            cell_depth_m=cell_depth_m,
            intrinsics=intrinsics,
            ref_from_cam=(poses[:, :1] @ torch.linalg.inv(poses)).float(),
            center=center,
            scale=scale,
        )

    def _truth(
        self, picks: list[tuple[CachedView, list[int]]], frames: FrameBatch, rng: np.random.Generator, *, disturb: bool
    ) -> WindowTruth:
        b, most = len(picks), max(view.visible.shape[1] for view, _ in picks)

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
        visible = padded("visible", per_frame=True)
        bound = visible[:, 0] & exists
        uv = padded("uv_px", per_frame=True) / self.network.encoder.image_size
        label = padded("label", per_frame=False).long()
        told = label.clone()
        anchor_uv = uv[:, 0].clone()
        if disturb:
            told[torch.from_numpy(rng.random((b, most)) >= self.config.label_share)] = UNKNOWN_LABEL
            noise = rng.normal(0, self.config.point_jitter_px, (b, most, 2)) / self.network.encoder.image_size
            anchor_uv += torch.from_numpy(noise.astype(np.float32))
            dropped = torch.from_numpy(rng.random((b, most)) < self.config.query_drop_share)
            bound &= ~dropped | ((bound & ~dropped).sum(dim=1, keepdim=True) == 0)
        else:
            told[:] = UNKNOWN_LABEL
        ref_from_world = torch.from_numpy(np.stack([v.cam_from_world[i[0]] for v, i in picks])).float()
        center, scale = frames.center[:, None], frames.scale[:, None, None]
        point = transform(ref_from_world[:, None, None], padded("point_world", per_frame=True))
        axis = padded("axis_world", per_frame=False)
        origin = (transform(ref_from_world[:, None], axis[..., :3]) - center) / scale
        direction = (ref_from_world[:, None, :3, :3] @ axis[..., 3:, None]).squeeze(-1)
        half = torch.tensor([view.half_diagonal_m for view, _ in picks], dtype=torch.float32)
        return WindowTruth(
            uv=uv,
            visible=visible,
            point=(point - center[:, None]) / scale[:, None],
            exists=exists,
            bound=bound,
            label=label,
            told=told,
            anchor_uv=anchor_uv.nan_to_num(0.5).clamp(0, 1),
            unit=half / frames.scale,
            revolute=padded("revolute", per_frame=False),
            axis=torch.cat((origin, direction), dim=-1),
        )
