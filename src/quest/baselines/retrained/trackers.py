"""The networks as trackers: frames on the canvas that they learned from, answers in pixels of the clip."""

from __future__ import annotations

from abc import abstractmethod
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32, Int
from torch import Tensor

from quest.baselines.chained import Chained, Points, Stepped
from quest.baselines.point_queries import Followed, PointTracker
from quest.baselines.retrained.layers import mesh, read_at
from quest.baselines.retrained.matcher import STRIDE, place_of
from quest.baselines.retrained.objective import read_retrained
from quest.baselines.retrained.refiner import Window
from quest.baselines.retrained.windows import PointWindow
from quest.data.provenance import file_hash
from quest.geometry.letterbox import Letterbox
from quest.track.tracker import pick_device
from quest.types import Clip

_SUPPORT = 6
"""Points along each side of a grid that are followed beside those that were asked for, as published."""


class _Retrained:
    """A network ready to answer.

    Raises:
        WeightsError: its weights are not in the folder, or are of another network.
    """

    def __init__(self, name: str, weights: Path) -> None:
        self.name = name
        self.device = pick_device("auto")
        path = weights if weights.is_file() else weights / f"{name}.safetensors"
        self.rival_hash = file_hash(path)
        self.network: Any = read_retrained(name, path).to(self.device).requires_grad_(requires_grad=False)

    def _box(self, clip: Clip) -> Letterbox:
        return Letterbox(clip.camera, self.network.config.image_size)

    def _picture(self, clip: Clip, t: int) -> Tensor:
        return torch.from_numpy(self._box(clip).rgb(clip.rgb[t]))[None].to(self.device)


class PairPicture(NamedTuple):
    """What flow looks at of a frame."""

    rgb: Tensor
    depth_m: Tensor
    box: Letterbox


class FlowTracker(_Retrained, Chained[PairPicture]):
    """Chains rigid flow; it never says that it lost anything that is in the image. Without depth it is plain flow."""

    def picture(self, clip: Clip, t: int) -> PairPicture:
        """Colours and depth on the canvas."""
        box = self._box(clip)
        depth_m = np.zeros((box.size, box.size), np.float32) if clip.depth_m is None else box.depth(clip.depth_m[t])
        return PairPicture(self._picture(clip, t), torch.from_numpy(depth_m)[None].to(self.device), box)

    @torch.inference_mode()
    def step(self, previous: PairPicture, picture: PairPicture, uv_px: Points) -> Stepped:
        """Where the bodies of points take them."""
        box = previous.box
        lens = torch.tensor([[getattr(box.camera, name) for name in ("fx", "fy", "cx", "cy")]], device=self.device)
        asked = torch.from_numpy(box.to_canvas(uv_px))[None].to(self.device)
        rgb, depth_m = (torch.stack((getattr(previous, n), getattr(picture, n)), 1) for n in ("rgb", "depth_m"))
        _, end = self.network(PointWindow(rgb, depth_m, lens.float(), asked))
        return box.to_source(end[0].cpu().numpy()), np.ones(len(uv_px), dtype=bool)


class _Windowed(_Retrained, PointTracker):
    """Follows the points of one first frame together."""

    @torch.inference_mode()
    def follow(self, clip: Clip, first: Int[np.ndarray, " K"], uv_first: Float32[np.ndarray, "K 2"]) -> Followed:
        """All points that begin in the same frame, one beginning after the other."""
        t, box = len(clip), self._box(clip)
        uv_px, logit = np.zeros((t, len(first), 2), np.float32), np.zeros((t, len(first)), np.float32)
        for start in np.unique(first):
            which = np.flatnonzero(first == start)
            asked = torch.from_numpy(box.to_canvas(uv_first[which]))[None].to(self.device)
            for frame, (uv, seen) in enumerate(self.frames(clip, int(start), asked), start=int(start)):
                uv_px[frame, which] = box.to_source(uv[0, : len(which)].cpu().numpy())
                logit[frame, which] = seen[0, : len(which)].cpu().numpy()
        return uv_px, logit > 0, (1 / (1 + np.exp(-logit))).astype(np.float32)

    @abstractmethod
    def frames(self, clip: Clip, start: int, uv_px: Float[Tensor, "1 N 2"]) -> Any:
        """Pixels of the canvas [1, N, 2] and log odds of "seen" [1, N] in every frame from ``start`` on."""


class MatchTracker(_Windowed):
    """Matches every frame by itself."""

    def frames(self, clip: Clip, start: int, uv_px: Float[Tensor, "1 N 2"]) -> Any:
        """Frame by frame."""
        query = None
        for t in range(start, len(clip)):
            maps = self.network.encode(self._picture(clip, t))
            query = read_at(maps, uv_px, STRIDE).mT if query is None else query
            where, logit = self.network.match(query, maps)
            yield place_of(where), logit


class RefineTracker(_Windowed):
    """Refines windows; an answer looks at most 7 frames ahead."""

    def frames(self, clip: Clip, start: int, uv_px: Float[Tensor, "1 N 2"]) -> Any:
        """Window by window, with a grid of points for support."""
        network = self.network
        size, span = network.config.image_size, network.config.window
        encode = lru_cache(span)(lambda t: network.encode(self._picture(clip, t)))  # windows overlap
        side = (torch.arange(_SUPPORT, device=uv_px.device) + 0.5) * size / _SUPPORT
        asked = torch.cat((uv_px, mesh(side, side).flatten(0, 1)[None]), dim=1)
        last: Window | None = None
        for at in range(start, max(start + 1, len(clip) - span // 2), span // 2):
            frames = range(at, min(at + span, len(clip)))
            shown, new = torch.stack([encode(t) for t in frames], dim=1), 0 if last is None else span // 2
            rough = network.begin(shown, asked) if last is None else network.slide(last, new).first(len(frames))
            window: Window = network.refine(shown, rough)[-1]
            for i in range(new, len(frames)):
                yield window.uv_px[:, i], window.logit[:, i]
            last = window
