"""Stage find: the finder's maps from labelled pictures and takes.

References: Law and Deng, CornerNet, ECCV 2018, equation 1, for the loss of the maps; Rezatofighi et al., Generalized
Intersection over Union, CVPR 2019, for that of extents.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from quest.data.boxed_pictures import in_boxes
from quest.errors import ConfigError
from quest.model.finder import COARSE_PX, CONTEXT_BLOCKS, FINE_PX, MIDDLE_PX, PLACES, FinderMaps, FinderNetwork
from quest.model.found import Odds, read_off, shared
from quest.model.second_look import SecondLook
from quest.train.finding.marks import UNKNOWN
from quest.train.finding.sampler import FinderInputs, FinderSampler, FinderTruth, whole_view
from quest.train.finding.settings import VIEW_PX
from quest.train.losses import changed, masked_mean
from quest.train.pooling import pooled

WEIGHTS = {
    "place": 1.0, "longer": 0.5, "longest": 0.5, "panel": 0.5, "extent": 1.0, "longer_extent": 0.5,
    "longest_extent": 0.5, "panel_extent": 1.0, "second": 1.0, "knob": 0.1, "lift": 0.1, "opening": 0.1,
}  # fmt: skip
"""How much every loss counts."""
_LOOKS = 128
"""How many second looks of a kind a step learns from."""
_MOVED, _MOVED_PX = 0.1, 1.5
"""Standard deviation by which edges are moved before the second look, in sides of the box and in pixels."""
_LEAST_SIDE_PX = 4.0
_SAME_BOX = 0.5
_SHARP = 0.05
"""Below so many sides of the box an edge is off by the square, above by the amount."""
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
    boxes: float
    """Average precision where an answer is right if its box and that of the grip share half of their union."""
    present: int
    """How many grips there are."""

    @property
    def score(self) -> float:
        """What a checkpoint is chosen by: points and boxes alike; less is better."""
        return 1 - (self.precision + self.boxes) / 2

    def __str__(self) -> str:
        return (
            f"grips: average precision {self.precision:.3f}, of boxes {self.boxes:.3f}, recall {self.recall:.1%} "
            f"(n = {self.present})"
        )


class StageFind:
    """The finder, with or without its transformer.

    Args:
        network: the finder.
        changes: weights of losses that are to differ; 0 turns one off.
        learned_blocks: last blocks of the transformer that learn too.
        second_alone: whether only the second looks learn.

    Raises:
        ConfigError: the transformer has fewer blocks.
    """

    name = "stage-find"

    def __init__(
        self,
        network: FinderNetwork,
        changes: Mapping[str, float] | None = None,
        *,
        learned_blocks: int = 0,
        second_alone: bool = False,
    ) -> None:
        self.network = network
        self.weights = changed(WEIGHTS, changes or {})
        read = network.encoder.blocks[: CONTEXT_BLOCKS[-1] + 1]
        if learned_blocks > len(read):
            raise ConfigError(f"finding: the transformer has {len(read)} blocks, fewer than {learned_blocks}")
        self._blocks = read[len(read) - learned_blocks :]
        self._second_alone = second_alone
        if second_alone:
            self.weights = {"second": self.weights["second"]}

    def trained(self) -> list[nn.Parameter]:
        """The transformer's last blocks and all outside of it, or all but the first stages of EfficientNet.

        The second looks' alone, if they learn alone.
        """
        if self._second_alone:
            return list(self.network.second.parameters())
        frozen = ("encoder.", *(() if len(self._blocks) else _FIRST))
        outside = [p for name, p in self.network.named_parameters() if not name.startswith(frozen)]
        return outside + self.refined()

    def refined(self) -> list[nn.Parameter]:
        """The transformer's last blocks."""
        return list(self._blocks.parameters())

    def losses(self, frames: FinderInputs, truth: FinderTruth) -> dict[str, Float[Tensor, ""]]:
        """Every loss, unweighted; that of the second looks alone, if they learn alone."""
        if self._second_alone:  # all else is as it will be when it is used
            self.network.eval()
            self.network.second.train()
        with torch.set_grad_enabled(torch.is_grad_enabled() and not self._second_alone):
            maps = self.network(frames.rgb.float() / 255, context=frames.context)
        if self._second_alone:
            return {"second": self._second(maps, truth)}
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
            "second": self._second(maps, truth),
            "knob": _binary(maps.knob, truth.knob),
            "lift": _binary(maps.lift, truth.lift),
            "opening": _choice(maps.opening, truth.opening),
        }

    def _second(self, maps: FinderMaps, truth: FinderTruth) -> Float[Tensor, ""]:
        """How far boxes are off after the second looks, both of which count the same."""
        looks = self.network.second
        grips = (
            (maps.extent, truth.extent, truth.weight, FINE_PX),
            (maps.longer_extent, truth.longer_extent, truth.longer_share[:, 0], MIDDLE_PX),
            (maps.longest_extent, truth.longest_extent, truth.longest_share[:, 0], COARSE_PX),
        )
        panels = ((maps.panel_extent, truth.panel_extent, truth.panel_weight, COARSE_PX),)
        features = maps.features.detach(), maps.deep_features.detach()
        return (_looked_again(looks.grip, grips, features) + _looked_again(looks.panel, panels, features)) / 2

    def validate(self, sampler: FinderSampler, *, batches: int, device: torch.device) -> FinderScores:
        """Scores on the same whole views at every call, as many as ``batches`` batches have."""
        paths = sampler.pictures or sampler.takes
        count = min(len(paths), batches * sampler.config.batch)
        self.network.eval()
        scores: list[float] = []
        first: dict[str, list[bool]] = {"point": [], "box": []}
        present = 0
        with torch.inference_mode():
            for i in np.linspace(0, len(paths) - 1, count).astype(int):
                view = sampler.view(paths[i], seed=int(i))
                seen = whole_view(view).to(device)
                maps = self.network(seen.rgb.float() / 255, context=seen.context)
                found = read_off(maps, self.network.second, scale=np.ones(2), size=(VIEW_PX, VIEW_PX), odds=Odds())
                found = found.select(~np.isnan(found.box_px[:, 0]))
                box = view.marks.box_px[view.marks.kind == PLACES.index("grip")]
                share = np.array([shared(own, box) for own in found.box_px]).reshape(len(found), len(box))
                for name, right in (("point", in_boxes(box, found.uv_px)), ("box", share >= _SAME_BOX)):
                    taken = np.zeros(len(box), bool)
                    for hits in right:
                        hit = np.flatnonzero(hits & ~taken)
                        first[name].append(len(hit) > 0)
                        taken[hit[:1]] = True
                scores += found.logit.tolist()
                present += len(box)
        self.network.train()
        order = np.argsort(-np.array(scores), kind="stable")
        point, boxes = (_average_precision(np.array(first[name], bool)[order], present) for name in ("point", "box"))
        return FinderScores(point, sum(first["point"]) / max(present, 1), boxes, present)


def _average_precision(right: Bool[np.ndarray, " N"], present: int) -> float:
    """Mean precision over the things that are there, of answers, best first."""
    precision = np.cumsum(right) / np.arange(1, len(right) + 1)
    return float(precision[right].sum() / max(present, 1))


def _looked_again(
    look: SecondLook, levels: Iterable[tuple[Tensor, Tensor, Tensor, int]], features: Sequence[Tensor]
) -> Float[Tensor, ""]:
    """How far boxes are off after a second look.

    It looks at what the first look said in some of their cells, moved by chance: the first look is nearer to the
    truth where it has learned than where it is used.

    Args:
        look: the look.
        levels: extents as the first look said and as they are, what each cell counts, and the stride, pixels.
        features: of the maps.
    """
    parts: list[tuple[Tensor, ...]] = []
    for said, true, weight, stride in levels:
        picture, row, column = weight.nonzero(as_tuple=True)
        centre = (torch.stack((column, row), dim=1) + 0.5) * stride
        first, goal = (
            torch.cat((centre - out[:, :2], centre + out[:, 2:]), dim=1)
            for out in (each[picture, :, row, column].detach() for each in (said, true))
        )
        parts.append((first, goal, weight[picture, row, column], picture))
    first, goal, share, picture = (torch.cat(part) for part in zip(*parts, strict=True))
    drawn = torch.multinomial(share, min(_LOOKS, len(share))) if len(share) else picture
    first, goal, picture = first[drawn], goal[drawn], picture[drawn]
    side = (goal[:, 2:] - goal[:, :2]).clamp(min=_LEAST_SIDE_PX).repeat(1, 2)
    first = first + torch.randn_like(first) * (_MOVED * side + _MOVED_PX)
    second = look(features, first, picture)
    off = (second - goal) / side
    edges = F.smooth_l1_loss(off, torch.zeros_like(off), reduction="none", beta=_SHARP).sum()
    middle = (goal[:, :2] + goal[:, 2:]).repeat(1, 2) / 2
    outward = torch.tensor([-1, -1, 1, 1], device=goal.device)
    said, true = (((box - middle) * outward)[..., None, None] for box in (second, goal))
    return edges / pooled(edges.new_tensor(len(off))).clamp(min=1) + _giou(said, true, torch.ones_like(said[:, 0]))


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
