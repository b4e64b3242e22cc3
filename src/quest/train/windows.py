"""Training windows: an anchor frame and T later or earlier frames of the same view, with their truth."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from quest.errors import ConfigError
from quest.geometry import transform
from quest.model.config import DecoderConfig
from quest.model.network import UNKNOWN_INTENT, UNKNOWN_LABEL
from quest.model.observation import FrameBatch, reference_of
from quest.train.feature_cache import DEPTH_UNIT_M, CachedView
from quest.train.plan import Disturbance, Pick, WindowPlan, draw_disturbance
from quest.train.settings import WindowConfig


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
    bound: Bool[Tensor, "B K"]
    """Entities that were seen at the anchor frame and are asked for."""
    label: Int[Tensor, "B K"]
    """Index into LABELS."""
    told: Int[Tensor, "B K"]
    """Label given to the query, or ``len(LABELS)``."""
    intent: Int[Tensor, "B K"]
    """Index into INTENTS."""
    told_intent: Int[Tensor, "B K"]
    """Intent given to the query, or ``len(INTENTS)``."""
    anchor_uv: Float[Tensor, "B K 2"]
    """Disturbed coordinates of the anchor."""
    unit: Float[Tensor, " B"]
    """Reference units per normalised unit."""
    revolute: Bool[Tensor, "B K"]
    """Whether the entity's joint turns."""
    axis: Float[Tensor, "B K 6"]
    """Origin and direction of its joint's axis in the reference frame."""
    flow: Float[Tensor, "B K 3"]
    """True displacement from the newest frame to the one after it, reference units. After it means at the window's own
    step between frames, back in time for a window that runs backwards; NaN where the view ends."""
    owner: Int[Tensor, "B S C"] | None = None
    """The entity that each cell is a part of, -1 for none; None but for anchor frames alone, of which the affordance
    map is learned."""

    def to(self, device: torch.device) -> WindowTruth:
        """The same on a device."""
        known = {f.name: value for f in fields(self) if (value := getattr(self, f.name)) is not None}
        return WindowTruth(**{name: value.to(device) for name, value in known.items()})


class WindowSampler:
    """Draws batches of windows from prepared views.

    Args:
        views: prepared views, drawn evenly: an object counts as often as it was filmed.
        network: network that the windows are for.
        config: how windows are drawn.
        anchors_only: whether to draw nothing but anchor frames, with the tokens of their enlarged images, which is
            all that the affordance map is learned from.

    Raises:
        ConfigError: nothing is visible in any view.
    """

    def __init__(
        self, views: list[CachedView], network: DecoderConfig, config: WindowConfig, *, anchors_only: bool = False
    ) -> None:
        self.network = network
        self.config = config
        self.anchors_only = anchors_only
        self.views = [view for view in views if view.visible.any()]
        if not self.views:
            raise ConfigError(f"training: no entity is visible in any of {len(views)} views; use other takes")

    def draw(self, rng: np.random.Generator, *, disturb: bool = True) -> tuple[FrameBatch, WindowTruth]:
        """One batch; ``disturb`` turns on everything that is random beyond the choice of frames."""
        return self.load(self.plan(rng, disturb=disturb))

    def plan(self, rng: np.random.Generator, *, disturb: bool = True) -> WindowPlan:
        """The windows of one batch, all that is random about them drawn and nothing large read."""
        chosen = [self._pick(self.views[rng.integers(len(self.views))], rng) for _ in range(self.config.batch)]
        entities = max(view.visible.shape[1] for view, *_ in chosen)
        return WindowPlan(
            picks=tuple((view, frames) for view, frames, _ in chosen),
            following=tuple(following for *_, following in chosen),
            entities=entities,
            disturbance=draw_disturbance(rng, self.config, windows=len(chosen), entities=entities) if disturb else None,
        )

    def load(self, plan: WindowPlan) -> tuple[FrameBatch, WindowTruth]:
        """Read what a plan, or a part of one, names."""
        frames = self._frames(plan.picks, plan.disturbance)
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
        window = [int(np.clip(end - stride * back, 0, len(view) - 1)) for back in range(self.network.window)]
        # A window whose newest step is cut short by an end of the view says nothing of what its next step would be.
        around = (end + stride,) if self.network.window == 1 else (end - stride, end + stride)
        following = end + stride if all(0 <= t < len(view) for t in around) else -1
        return view, [anchor] if self.anchors_only else [anchor, *reversed(window)], following

    def _frames(self, picks: tuple[Pick, ...], disturbance: Disturbance | None) -> FrameBatch:
        def gather(name: str) -> np.ndarray:
            return np.stack([getattr(view, name)[index] for view, index in picks])

        depth_m = torch.from_numpy(gather("depth").astype(np.float32) * DEPTH_UNIT_M)
        cell_depth_m = torch.from_numpy(gather("cell_depth_m"))
        rgb = gather("rgb")
        if disturbance is not None:
            dropped = torch.from_numpy(disturbance.no_depth)
            depth_m[dropped] = 0
            cell_depth_m[dropped] = 0
            rgb = np.clip(rgb * disturbance.gain, 0, 255).astype(np.uint8)
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
            enlarged=torch.from_numpy(gather("enlarged")).float() if self.anchors_only else None,
        )

    def _truth(self, plan: WindowPlan, frames: FrameBatch) -> WindowTruth:
        picks, b, most, disturbance = plan.picks, len(plan), plan.entities, plan.disturbance

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
        axis = padded("axis_world", per_frame=False)
        # What no joint moves is there to be lifted by (see quest.types.Entity.intent).
        intent = (axis[..., 3:] == 0).all(-1).long()
        told, told_intent = label.clone(), intent.clone()
        anchor_uv = uv[:, 0].clone()
        if disturbance is not None:
            told[torch.from_numpy(disturbance.untold)] = UNKNOWN_LABEL
            told_intent[torch.from_numpy(disturbance.untold_intent)] = UNKNOWN_INTENT
            anchor_uv += torch.from_numpy(disturbance.noise_px) / self.network.encoder.image_size
            dropped = torch.from_numpy(disturbance.left_out)
            bound &= ~dropped | ((bound & ~dropped).sum(dim=1, keepdim=True) == 0)
        else:
            told[:], told_intent[:] = UNKNOWN_LABEL, UNKNOWN_INTENT
        ref_from_world = torch.from_numpy(np.stack([v.cam_from_world[i[0]] for v, i in picks])).float()
        center, scale = frames.center[:, None], frames.scale[:, None, None]
        point = transform(ref_from_world[:, None, None], padded("point_world", per_frame=True))
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
            intent=intent,
            told_intent=told_intent,
            anchor_uv=anchor_uv.nan_to_num(0.5).clamp(0, 1),
            unit=half / frames.scale,
            revolute=padded("revolute", per_frame=False),
            axis=torch.cat((origin, direction), dim=-1),
            flow=_flow(plan, ref_from_world) / scale,
            owner=_owner(plan) if self.anchors_only else None,
        )


def _owner(plan: WindowPlan) -> Int[Tensor, "B S C"]:
    return torch.from_numpy(np.stack([view.owner[frames] for view, frames in plan.picks])).long()


def _flow(plan: WindowPlan, ref_from_world: Float[Tensor, "B 4 4"]) -> Float[Tensor, "B K 3"]:
    """Displacements to the frame after each window in the reference axes, metres."""
    out = np.full((len(plan), plan.entities, 3), np.nan, np.float32)
    for i, ((view, frames), following) in enumerate(zip(plan.picks, plan.following, strict=True)):
        if following >= 0:
            out[i, : view.visible.shape[1]] = view.point_world[following] - view.point_world[frames[-1]]
    return (ref_from_world[:, None, :3, :3] @ torch.from_numpy(out).unsqueeze(-1)).squeeze(-1)
