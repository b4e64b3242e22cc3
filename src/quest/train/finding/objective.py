"""Stage find: the finder's maps from labelled pictures and takes.

References: Law and Deng, CornerNet, ECCV 2018, equation 1, for the loss of the maps; Rezatofighi et al., Generalized
Intersection over Union, CVPR 2019, for that of extents.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from quest.data.boxed_pictures import in_boxes
from quest.errors import ConfigError
from quest.model.finder import CONTEXT_BLOCKS, PLACES, FinderNetwork
from quest.model.found import read_off
from quest.train.finding.marks import UNKNOWN
from quest.train.finding.sampler import FinderInputs, FinderSampler, FinderTruth, whole_view
from quest.train.finding.settings import VIEW_PX
from quest.train.losses import changed, masked_mean
from quest.train.pooling import pooled

WEIGHTS = {
    "place": 1.0, "longer": 0.5, "longest": 0.5, "panel": 0.5, "extent": 1.0, "longer_extent": 0.5,
    "longest_extent": 0.5, "panel_extent": 1.0, "knob": 0.1, "lift": 0.1, "opening": 0.1,
}  # fmt: skip
"""How much every loss counts."""
_FIRST = ("detail.stem.", *(f"detail.stages.{i}." for i in range(3)))
"""What stays as it was if the transformer does: edges and textures, which ImageNet has taught, and which cost most of a
step."""


@dataclass(frozen=True)
class FinderScores:
    """Grips in whole views that did not teach, of pictures or, where there are none, of takes."""

    precision: float
    """Average precision over all answers (see :func:`quest.data.boxed_pictures.in_boxes`)."""
    recall: float
    """Share of the grips that any answer is right about."""
    present: int
    """How many grips there are."""

    @property
    def score(self) -> float:
        """What a checkpoint is chosen by; less is better."""
        return 1 - self.precision

    def __str__(self) -> str:
        return f"grips: average precision {self.precision:.3f}, recall {self.recall:.1%} (n = {self.present})"


class StageFind:
    """The finder, with or without its transformer.

    Args:
        network: the finder.
        changes: weights of losses that are to differ; 0 turns one off.
        learned_blocks: last blocks of the transformer that learn too.

    Raises:
        ConfigError: the transformer has fewer blocks.
    """

    name = "stage-find"

    def __init__(
        self, network: FinderNetwork, changes: Mapping[str, float] | None = None, *, learned_blocks: int = 0
    ) -> None:
        self.network = network
        self.weights = changed(WEIGHTS, changes or {})
        read = network.encoder.blocks[: CONTEXT_BLOCKS[-1] + 1]
        if learned_blocks > len(read):
            raise ConfigError(f"finding: the transformer has {len(read)} blocks, fewer than {learned_blocks}")
        self._blocks = read[len(read) - learned_blocks :]

    def trained(self) -> list[nn.Parameter]:
        """The transformer's last blocks and all outside of it, or all but the first stages of EfficientNet."""
        frozen = ("encoder.", *(() if len(self._blocks) else _FIRST))
        outside = [p for name, p in self.network.named_parameters() if not name.startswith(frozen)]
        return outside + self.refined()

    def refined(self) -> list[nn.Parameter]:
        """The transformer's last blocks."""
        return list(self._blocks.parameters())

    def losses(self, frames: FinderInputs, truth: FinderTruth) -> dict[str, Float[Tensor, ""]]:
        """Every loss, unweighted."""
        maps = self.network(frames.rgb.float() / 255, context=frames.context)
        places, grip = len(PLACES), PLACES.index("grip")
        grips = truth.known[:, grip : grip + 1]
        return {
            "place": _focal(maps.place, truth.place, truth.place_share, truth.known[:, :places]),
            "longer": _focal(maps.longer[:, None], truth.longer, truth.longer_share, grips),
            "longest": _focal(maps.longest[:, None], truth.longest, truth.longest_share, grips),
            "panel": _focal(maps.panel, truth.panel, truth.panel_share, truth.known[:, places:]),
            "extent": _giou(maps.extent, truth.extent, truth.weight),
            "longer_extent": _giou(maps.longer_extent, truth.longer_extent, truth.longer_share[:, 0]),
            "longest_extent": _giou(maps.longest_extent, truth.longest_extent, truth.longest_share[:, 0]),
            "panel_extent": _giou(maps.panel_extent, truth.panel_extent, truth.panel_weight),
            "knob": _binary(maps.knob, truth.knob),
            "lift": _binary(maps.lift, truth.lift),
            "opening": _choice(maps.opening, truth.opening),
        }

    def validate(self, sampler: FinderSampler, *, batches: int, device: torch.device) -> FinderScores:
        """Scores on the same whole views at every call, as many as ``batches`` batches have."""
        paths = sampler.pictures or sampler.takes
        count = min(len(paths), batches * sampler.config.batch)
        self.network.eval()
        scores: list[float] = []
        first: list[bool] = []
        present = 0
        with torch.inference_mode():
            for i in np.linspace(0, len(paths) - 1, count).astype(int):
                view = sampler.view(paths[i], seed=int(i))
                seen = whole_view(view).to(device)
                maps = self.network(seen.rgb.float() / 255, context=seen.context)
                found = read_off(maps, scale=np.ones(2), size=(VIEW_PX, VIEW_PX))
                found = found.select(~np.isnan(found.box_px[:, 0]))
                box = view.marks.box_px[view.marks.kind == PLACES.index("grip")]
                taken = np.zeros(len(box), bool)
                for inside, logit in zip(in_boxes(box, found.uv_px), found.logit, strict=True):
                    hit = np.flatnonzero(inside & ~taken)
                    scores.append(float(logit))
                    first.append(len(hit) > 0)
                    taken[hit[:1]] = True
                present += len(box)
        self.network.train()
        right = np.array(first, bool)[np.argsort(-np.array(scores), kind="stable")]
        precision = np.cumsum(right) / np.arange(1, len(right) + 1)
        area = float(precision[right].sum() / max(present, 1))
        return FinderScores(area, float(right.sum() / max(present, 1)), present)


def _focal(
    logit: Float[Tensor, "B C h w"],
    near: Float[Tensor, "B C h w"],
    share: Float[Tensor, "B C h w"],
    known: Bool[Tensor, "B C"],
) -> Float[Tensor, ""]:
    """Focal loss per mark, in pictures where its kind is labelled."""
    p = logit.sigmoid()
    here, elsewhere = share * (1 - p) ** 2 * F.logsigmoid(logit), (1 - near) ** 4 * p**2 * F.logsigmoid(-logit)
    counted = known[..., None, None]
    return -((here + elsewhere) * counted).sum() / pooled((share * counted).sum()).clamp(min=1)


def _giou(
    out: Float[Tensor, "B 4 h w"], true: Float[Tensor, "B 4 h w"], weight: Float[Tensor, "B h w"]
) -> Float[Tensor, ""]:
    """One minus the generalised intersection over union of boxes around the same cells."""
    (left, up, right, down), (left_t, up_t, right_t, down_t) = out.unbind(1), true.unbind(1)
    shared, hull = (
        (pick(left, left_t) + pick(right, right_t)).clamp(min=0) * (pick(up, up_t) + pick(down, down_t)).clamp(min=0)
        for pick in (torch.minimum, torch.maximum)
    )
    union = (left + right) * (up + down) + (left_t + right_t) * (up_t + down_t) - shared
    giou = shared / union - (hull - union) / hull
    return ((1 - giou) * weight).sum() / pooled(weight.sum()).clamp(min=1e-6)


def _binary(logit: Float[Tensor, "B h w"], true: Tensor) -> Float[Tensor, ""]:
    loss = F.binary_cross_entropy_with_logits(logit, true.clamp(min=0).float(), reduction="none")
    return masked_mean(loss, true != UNKNOWN)


def _choice(logit: Float[Tensor, "B O h w"], true: Tensor) -> Float[Tensor, ""]:
    loss = F.cross_entropy(logit, true.clamp(min=0), reduction="none")
    return masked_mean(loss, true != UNKNOWN)
