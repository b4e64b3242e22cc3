"""RAFT and RAFT-3D by their authors' code, chained from frame to frame and lifted by depth.

References: Teed and Deng, RAFT: Recurrent All-Pairs Field Transforms for Optical Flow, ECCV 2020, and RAFT-3D: Scene
Flow using Rigid-Motion Embeddings, CVPR 2021. Pixel centres there lie at integers; sides are multiples of 8.
"""

from __future__ import annotations

import sys
from argparse import Namespace
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float32, UInt8
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from quest.baselines.chained import Chained, Points, Stepped, moved
from quest.baselines.official import Official, import_code
from quest.errors import ConfigError, InputError
from quest.types import Camera, Clip

STEPS, STEPS_3D = 20, 16
"""Iterations per pair of frames, as in their demo and evaluation."""
DEPTH_SCALE = 0.2
"""What RAFT-3D is given is metres times this, as in its own evaluation."""
Colours = UInt8[np.ndarray, "H W 3"]
_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class Raft(Official, Chained[Colours]):
    """Optical flow; it never says that it lost anything that is in the image."""

    def __init__(self, name: str, rivals: Path) -> None:
        code = import_code(rivals / "RAFT" / "core", "raft")
        network = code.RAFT(Namespace(small=False, mixed_precision=False, alternate_corr=False))
        super().__init__(name, rivals, network)

    def picture(self, clip: Clip, t: int) -> Colours:
        """Colours."""
        return clip.rgb[t]

    @torch.no_grad()
    def step(self, previous: Colours, picture: Colours, uv_px: Points) -> Stepped:
        """The flow at the point."""
        pair = [to_maps(colours, self.device) for colours in (previous, picture)]
        _, flow_px = self.network(*pair, iters=STEPS, test_mode=True)
        return moved(to_field(flow_px.permute(0, 2, 3, 1), previous), uv_px)


class DepthPicture(NamedTuple):
    """What RAFT-3D looks at of a frame; depth in metres, 0 where missing."""

    rgb: Colours
    depth_m: Float32[np.ndarray, "H W"]
    camera: Camera


class Raft3D(Official, Chained[DepthPicture]):
    """Scene flow, of which the motion in the image is followed. Where depth is missing it sees the nearest there is.

    It runs on CUDA alone: its kernels, ``lietorch`` with ``lietorch_extras``, have to be built there.
    """

    def __init__(self, name: str, rivals: Path) -> None:
        with _no_download():
            code = import_code(rivals / "RAFT-3D", "raft3d.raft3d")
            network = code.RAFT3D(Namespace())
        super().__init__(name, rivals, network)
        self.induced_flow = code.pops.induced_flow

    def picture(self, clip: Clip, t: int) -> DepthPicture:
        """Colours and depth.

        Raises:
            InputError: a clip without depth.
        """
        if clip.depth_m is None:
            raise InputError(f"tracker {self.name!r}: expected depth, which clip {clip.name!r} has not")
        return DepthPicture(clip.rgb[t], clip.depth_m[t], clip.camera)

    @torch.no_grad()
    def step(self, previous: DepthPicture, picture: DepthPicture, uv_px: Points) -> Stepped:
        """The flow at the point, of the field of rigid motions; nothing is found where a frame has no depth at all."""
        if not ((previous.depth_m > 0).any() and (picture.depth_m > 0).any()):
            return uv_px, np.zeros(len(uv_px), dtype=bool)
        mean, std = (torch.tensor(v, device=self.device)[:, None, None] for v in (_MEAN, _STD))
        images = [(to_maps(p.rgb, self.device) / 255 - mean) / std for p in (previous, picture)]
        depths = [to_maps(filled(p.depth_m)[..., None], self.device)[:, 0] * DEPTH_SCALE for p in (previous, picture)]
        camera = previous.camera
        lens = torch.tensor([[camera.fx, camera.fy, camera.cx - 0.5, camera.cy - 0.5]], device=self.device)
        motion = self.network(*images, *depths, lens, iters=STEPS_3D)
        flow_px, _, _ = self.induced_flow(motion, depths[0], lens)
        return moved(to_field(flow_px[..., :2], previous.rgb), uv_px)


def to_maps(values: np.ndarray, device: torch.device) -> Float32[Tensor, "1 C H W"]:
    """A picture with its last column and row repeated until both sides are multiples of 8."""
    height, width = values.shape[:2]
    maps = torch.from_numpy(np.ascontiguousarray(values)).to(device).permute(2, 0, 1)[None].float()
    return F.pad(maps, (0, -width % 8, 0, -height % 8), mode="replicate")


def to_field(flow_px: Tensor, picture: np.ndarray) -> Float32[np.ndarray, "H W 2"]:
    """Of a batch of one, the part in which the picture is."""
    height, width = picture.shape[:2]
    return np.ascontiguousarray(flow_px[0, :height, :width].float().cpu().numpy())


def filled(depth_m: Float32[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
    """Depth of the nearest pixel that has some."""
    nearest = np.asarray(distance_transform_edt(~(depth_m > 0), return_distances=False, return_indices=True))
    return depth_m[nearest[0], nearest[1]]


@contextmanager
def _no_download() -> Iterator[None]:
    """The official network fetches a ResNet, as a pickle, that the checkpoint then replaces; here it gets a random one.

    The module that it has this from is gone from today's torchvision, too.
    """
    try:
        resnet50 = import_module("torchvision.models").resnet50
    except ImportError as error:
        raise ConfigError(f"RAFT-3D needs torchvision, which cannot be imported ({error})") from error
    name = "torchvision.models.utils"
    stand_in: Any = ModuleType(name)
    stand_in.load_state_dict_from_url = lambda url: resnet50().state_dict()
    own, sys.modules[name] = sys.modules.get(name), stand_in
    try:
        yield
    finally:
        del sys.modules[name]
        if own is not None:
            sys.modules[name] = own
