"""TAPIR, BootsTAPIR and TAPNext by their authors' code.

References: Doersch et al., TAPIR: Tracking Any Point with per-frame Initialization and temporal Refinement, ICCV 2023,
and BootsTAP, ACCV 2024; Zholus et al., TAPNext: Tracking Any Point (TAP) as Next Token Prediction, ICCV 2025.
All see 256 x 256 pixels, colours from -1 to 1, and points (t, y, x) with pixel centres at half-integers.
"""

from __future__ import annotations

from abc import abstractmethod
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float32, Int, UInt8
from torch import Tensor

from quest.baselines.official import Official, import_code
from quest.baselines.point_queries import Followed, PointTracker
from quest.types import Clip

SIDE_PX = 256
"""Of the square into which a picture is stretched, as in their own evaluation."""
_CHUNK = 64
Answer = tuple[Float32[Tensor, "T K 2"], Float32[Tensor, "T K"]]
"""Points (x, y) in the square, and the probabilities that they are visible."""
Video = Float32[Tensor, "1 T S S 3"]
Queries = Float32[Tensor, "1 K 3"]


class Tapnet(Official, PointTracker):
    """What they share: pictures and points come in, and answers go out, in the picture's own pixels."""

    @torch.no_grad()
    def follow(self, clip: Clip, first: Int[np.ndarray, " K"], uv_first: Float32[np.ndarray, "K 2"]) -> Followed:
        """Confidence is the probability that the point is visible."""
        zoom = np.array((clip.camera.width, clip.camera.height), np.float32) / SIDE_PX
        tyx = np.column_stack((first, (uv_first / zoom)[:, ::-1])).astype(np.float32)
        xy, p_visible = self.answer(self._video(clip.rgb), torch.from_numpy(tyx).to(self.device)[None])
        p = p_visible.float().cpu().numpy()
        return xy.float().cpu().numpy() * zoom, p > 0.5, p

    @abstractmethod
    def answer(self, video: Video, queries: Queries) -> Answer:
        """What the network says of points (t, y, x)."""

    def _video(self, rgb: UInt8[np.ndarray, "T H W 3"]) -> Video:
        small = []
        for frame in rgb:
            maps = torch.from_numpy(np.ascontiguousarray(frame)).to(self.device).permute(2, 0, 1)[None].float()
            small.append(F.interpolate(maps, (SIDE_PX, SIDE_PX), mode="bilinear", antialias=True))
        return (torch.cat(small).permute(0, 2, 3, 1)[None] / 127.5 - 1).contiguous()


class Tapir(Tapnet):
    """TAPIR and BootsTAPIR; ``causal`` weights see a frame after the other, others the whole clip at once.

    BootsTAPIR has a pyramid and convolutions that TAPIR has not.
    """

    def __init__(self, name: str, rivals: Path, *, causal: bool, boots: bool) -> None:
        code = import_code(rivals / "tapnet", "tapnet.torch.tapir_model")
        network = code.TAPIR(pyramid_level=int(boots), extra_convs=boots, use_casual_conv=causal)
        super().__init__(name, rivals, network)
        self.causal = causal

    def answer(self, video: Video, queries: Queries) -> Answer:
        """Visible is what is neither occluded nor uncertain."""
        said = self._stream(video, queries) if self.causal else self.network(video, queries, query_chunk_size=_CHUNK)
        p_visible = (1 - said["occlusion"][0].sigmoid()) * (1 - said["expected_dist"][0].sigmoid())
        return said["tracks"][0].transpose(0, 1), p_visible.T

    def _stream(self, video: Video, queries: Queries) -> dict[str, Tensor]:
        """A frame after the other; the memory of a point is empty when its frame comes."""
        network, first = self.network, queries[0, :, 0].long()
        own, at = first.unique(return_inverse=True)
        points = torch.cat((at[None, :, None].float(), queries[..., 1:]), dim=-1)
        grids = network.get_feature_grids(video[:, own], is_training=False)
        features = network.get_query_features(
            video[:, own], is_training=False, query_points=points, feature_grids=grids
        )
        empty = network.construct_initial_causal_state(len(first), len(features.resolutions) - 1)
        memory = [{name: part.to(self.device, copy=True) for name, part in each.items()} for each in empty]
        frames: list[dict[str, Any]] = []
        for t in range(video.shape[1]):
            for each in memory:
                for part in each.values():
                    part[:, first == t] = 0
            said = network.estimate_trajectories(
                video.shape[2:4],
                is_training=False,
                feature_grids=network.get_feature_grids(video[:, t : t + 1], is_training=False),
                query_features=features,
                query_points_in_video=None,
                query_chunk_size=_CHUNK,
                causal_context=memory,
                get_causal_context=True,
            )
            memory = said.pop("causal_context")
            frames.append(said)
        names = ("tracks", "occlusion", "expected_dist")
        return {name: torch.cat([said[name][-1] for said in frames], dim=2) for name in names}


class TapNext(Tapnet):
    """TAPNext and TAPNext++, a frame after the other."""

    def __init__(self, name: str, rivals: Path) -> None:
        code = import_code(rivals / "tapnet", "tapnet.tapnext.tapnext_torch")
        super().__init__(name, rivals, code.TAPNext(image_size=(SIDE_PX, SIDE_PX)))

    def answer(self, video: Video, queries: Queries) -> Answer:
        """The network takes up each point in its frame; its answers are (y, x)."""
        yx, logits, state = [], [], None
        for t in range(video.shape[1]):
            asked = {"query_points": queries} if state is None else {"state": state}
            tracks, _, visible, state = self.network(video=video[:, t : t + 1], **asked)
            yx.append(tracks[0, 0])
            logits.append(visible[0, 0, :, 0])
        return torch.stack(yx).flip(-1), torch.stack(logits).sigmoid()
