"""Packages that look like the official ones from outside: same modules, classes, arguments and shapes; nothing inside.

Recorded from facebookresearch/co-tracker 82e02e8, google-deepmind/tapnet c2cbab8, princeton-vl/RAFT 2888e15 and
princeton-vl/RAFT-3D 877eb80. They check what they are given and let every point move by :data:`MOVE_PX` a frame.
"""

from __future__ import annotations

import textwrap
from pathlib import Path

import torch
from safetensors.torch import save_file

MOVE_PX = (2.0, -1.0)
"""In pixels of the picture, of a size of :data:`SIZE`."""
SIZE = (96, 72)
HIDDEN = 3
"""Frame, from the first that is asked for on, in which points are said to be occluded."""

_COMMON = f"""
import torch
from torch import nn
MOVE = torch.tensor({MOVE_PX})
SIZE = torch.tensor({SIZE})
HIDDEN = {HIDDEN}
class Network(nn.Module):
    def __init__(self, **parts):
        super().__init__()
        self.layer = nn.Linear(2, 3)
        self.parts = parts
"""

_COTRACKER = """
torch.manual_seed(0)
def answer(queries, frames):
    t = torch.arange(frames)[:, None]
    tracks = queries[0, :, 1:] + (t - queries[0, :, 0])[..., None] * MOVE
    return tracks[None], (t != HIDDEN).expand(-1, queries.shape[1])[None]
def check(video):
    assert video.dtype == torch.float32 and video.shape[0] == 1 and video.shape[2:] == (3, SIZE[1], SIZE[0])
    assert video.min() >= 0 and 128 < video.max() <= 255
class CoTrackerPredictor(nn.Module):
    def __init__(self, checkpoint="./checkpoints/scaled_offline.pth", offline=True, v2=False, window_len=60):
        super().__init__()
        assert checkpoint is None and offline and not v2 and window_len == 60
        self.model = Network()
    def forward(self, video, queries=None, segm_mask=None, grid_size=0, grid_query_frame=0, backward_tracking=False):
        check(video)
        return answer(queries, video.shape[1])
class CoTrackerOnlinePredictor(nn.Module):
    def __init__(self, checkpoint="./checkpoints/scaled_online.pth", offline=False, v2=False, window_len=16):
        super().__init__()
        assert checkpoint is None and not v2
        self.model, self.step = Network(), window_len // 2
    def forward(self, video_chunk, is_first_step=False, queries=None, grid_size=5, grid_query_frame=0,
                add_support_grid=False):
        check(video_chunk)
        assert add_support_grid
        frames = video_chunk.shape[1]
        if is_first_step:
            self.queries, self.frames = queries.clone(), 0
            return None, None
        assert self.step < frames <= 2 * self.step
        self.frames += min(self.step, frames - self.step) if self.frames else frames
        return answer(self.queries, self.frames)
"""

_TAPIR = """
import collections
Grids = collections.namedtuple("Grids", "lowres hires resolutions")
SCALE = 256 / SIZE
def check(video):
    assert video.dtype == torch.float32 and video.shape[0] == 1 and video.shape[2:] == (256, 256, 3)
    assert -1 <= video.min() < -0.5 and 0.5 < video.max() <= 1
class TAPIR(Network):
    def __init__(self, bilinear_interp_with_depthwise_conv=False, num_pips_iter=4, pyramid_level=1, extra_convs=True,
                 use_casual_conv=False):
        super().__init__(pyramid_level=pyramid_level, extra_convs=extra_convs, use_casual_conv=use_casual_conv)
    def forward(self, video, query_points, is_training=False, query_chunk_size=64, get_query_feats=False,
                refinement_resolutions=None):
        check(video)
        t = torch.arange(video.shape[1])
        moves = (t - query_points[0, :, :1])[..., None] * MOVE * SCALE
        hidden = torch.where(t == HIDDEN, 5.0, -5.0).expand(1, query_points.shape[1], -1)
        return {"tracks": (query_points[0, :, None, [2, 1]] + moves)[None], "occlusion": hidden,
                "expected_dist": torch.full_like(hidden, -5.0)}
    def get_feature_grids(self, video, is_training, refinement_resolutions=None):
        check(video)
        return Grids((video,), (video,), ((256, 256), (256, 256)))
    def get_query_features(self, video, is_training, query_points, feature_grids=None, refinement_resolutions=None):
        assert query_points[..., 0].max() < video.shape[1]
        return Grids((query_points,), (query_points,), feature_grids.resolutions)
    def construct_initial_causal_state(self, num_points, num_resolutions=1):
        return [{"block_0_causal_1": torch.zeros(1, num_points, 2, 512)}] * num_resolutions * 4
    def estimate_trajectories(self, video_size, is_training, feature_grids, query_features, query_points_in_video,
                              query_chunk_size=None, causal_context=None, get_causal_context=False):
        assert tuple(video_size) == (256, 256) and query_points_in_video is None and get_causal_context
        assert feature_grids.lowres[0].shape[1] == 1 and len(causal_context) == 4
        age = causal_context[0]["block_0_causal_1"][:, :, 0, 0]
        tracks = query_features.lowres[0][..., [2, 1]] + age[..., None] * MOVE * SCALE
        seen = torch.where(age == HIDDEN, 5.0, -5.0)[..., None]
        after = [{k: v + 1 for k, v in each.items()} for each in causal_context]
        one = {"tracks": tracks[:, :, None], "occlusion": seen, "expected_dist": torch.full_like(seen, -5.0)}
        return {**{k: [torch.zeros_like(v), v] for k, v in one.items()}, "causal_context": after}
"""

_TAPNEXT = """
SCALE = 256 / SIZE
class TAPNext(Network):
    def __init__(self, image_size, width=768, patch_size=(8, 8)):
        assert image_size == (256, 256)
        super().__init__()
    def forward(self, video, query_points=None, state=None):
        assert video.shape == (1, 1, 256, 256, 3) and -1 <= video.min() < 0 < video.max() <= 1
        assert (query_points is None) != (state is None)
        step, query_points = (0, query_points) if state is None else state
        age = step - query_points[..., :1]
        yx = query_points[..., 1:] + age * (MOVE * SCALE).flip(0)
        visible = torch.where(torch.tensor(step == HIDDEN), -5.0, 5.0).expand(1, 1, yx.shape[1], 1)
        return torch.where(age < 0, 0, yx)[None], torch.zeros(1, 1, yx.shape[1], 512), visible, (step + 1, query_points)
"""

_RAFT = """
from utils.utils import flow_like
class RAFT(Network):
    def __init__(self, args):
        super().__init__()
        assert not args.small and not args.mixed_precision and not args.alternate_corr and "dropout" not in args
    def forward(self, image1, image2, iters=12, flow_init=None, upsample=True, test_mode=False):
        assert test_mode and image1.shape == image2.shape and image1.shape[:2] == (1, 3)
        assert image1.shape[2] % 8 == image1.shape[3] % 8 == 0 and 128 < image1.max() <= 255
        flow = flow_like(image1[:, :2], MOVE)
        return flow[..., ::8, ::8], flow
"""

_RAFT_UTILS = """
def flow_like(maps, move):
    return move[:, None, None].expand_as(maps)
"""

_RAFT3D = """
from lietorch import SE3
from torchvision.models.utils import load_state_dict_from_url
from . import projective_ops as pops
class RAFT3D(Network):
    def __init__(self, args):
        super().__init__()
        self.cnet = nn.Linear(2, 2)
        self.cnet.load_state_dict(load_state_dict_from_url("https://somewhere/resnet50.pth"))
    def forward(self, image1, image2, depth1, depth2, intrinsics, iters=12, train_mode=False):
        assert image1.shape == image2.shape and image1.shape[1] == 3 and -3 < image1.min() < 0 < image1.max() < 3
        assert depth1.shape == depth2.shape == (1, *image1.shape[2:]) and depth1.min() > 0 and depth2.min() > 0
        assert intrinsics.tolist() == [[100.0, 100.0, SIZE[0] / 2 - 0.5, SIZE[1] / 2 - 0.5]]
        return SE3.Identity(*depth1.shape)
"""

_POPS = """
def induced_flow(Ts, depth, intrinsics):
    move = torch.cat((MOVE, torch.zeros(1))).expand(*depth.shape, 3)
    return move, move, torch.ones_like(depth)
"""

_LIETORCH = """
class SE3:
    @staticmethod
    def Identity(*size):
        return size
"""

_TORCHVISION = """
from torch import nn
def resnet50():
    return nn.Linear(2, 2)
"""

FILES = {
    "co-tracker/cotracker/predictor.py": _COMMON + _COTRACKER,
    "tapnet/tapnet/torch/tapir_model.py": _COMMON + _TAPIR,
    "tapnet/tapnet/tapnext/tapnext_torch.py": _COMMON + _TAPNEXT,
    "RAFT/core/raft.py": _COMMON + _RAFT,
    "RAFT/core/utils/utils.py": _RAFT_UTILS,
    "RAFT-3D/raft3d/raft3d.py": _COMMON + _RAFT3D,
    "RAFT-3D/raft3d/projective_ops.py": _COMMON + _POPS,
    "installed/lietorch.py": _LIETORCH,
    "installed/torchvision/models/__init__.py": _TORCHVISION,
}
"""What is written; ``installed`` is what pip would have installed."""


def write_rivals(folder: Path, names: list[str]) -> Path:
    """Code and weights of rivals."""
    for path, text in FILES.items():
        file = folder / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(textwrap.dedent(text))
    weights = {"layer.weight": torch.ones(3, 2), "layer.bias": torch.zeros(3)}
    for name in names:
        own = {"cnet.weight": torch.ones(2, 2), "cnet.bias": torch.ones(2)} if name == "raft-3d-official" else {}
        save_file(weights | own, folder / f"{name}.safetensors")
    return folder
