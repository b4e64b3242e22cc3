"""The finder's network: what in a picture can be taken hold of, and of which door or drawer.

Two branches see the picture: a vision transformer, coarsely, knows what things are; EfficientNet-Lite0 sees them at up
to a quarter of the picture's resolution. They are joined at a stride of 16 pixels, where the doors and drawers are read
off; going down from there to a stride of 4 pixels, what one takes hold of. Second looks
(:mod:`quest.model.second_look`) find the edges of both.

References: Zhou et al., Objects as Points, 2019, for maps of centres; Lin et al., Feature Pyramid Networks, CVPR 2017.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from quest.model.config import NetworkConfig
from quest.model.efficientnet import WIDTHS, EfficientNet
from quest.model.encoder import Encoder
from quest.model.second_look import SecondLooks

PLACES = ("grip", "rim", "front", "hinge")
"""What the fine map finds; a grip is a handle or a knob."""
PANELS = ("cabinet", "door", "refrigerator")
"""What the coarse map finds: doors and drawer fronts of furniture, doors of rooms, doors of refrigerators."""
OPENINGS = ("slides", "left", "right", "top", "bottom")
"""How a panel opens: it slides out, or turns about one of its edges."""
FINE_PX, MIDDLE_PX, COARSE_PX = 4, 8, 16
"""Strides of the maps."""
CONTEXT_BLOCKS = (5, 8, 11)
"""Blocks of the vision transformer whose tokens are read."""
CONTEXT_SHARE = (7, 10)
"""Size of the picture that the vision transformer sees, as a fraction of the one that EfficientNet sees."""
_STEPS = (1, 2, 3)
"""Dilations where the branches are joined, so that a door's middle sees its edges ..."""
_MIDDLE_STEPS = (1, 2, 4)
"""... and between, so that a handle's middle sees its ends."""
_GROUPS = 8
_RARE = -4.6
"""Logit of a place before anything is learned: one in a hundred."""


@dataclass(frozen=True, kw_only=True)
class FinderConfig(NetworkConfig):
    """Shape of the network."""

    width: int = 64
    """Channels of the fine levels."""
    deep_width: int = 128
    """Channels where the branches are joined."""


@dataclass(frozen=True)
class FinderMaps:
    """What is found where."""

    place: Float[Tensor, "B P h w"]
    """Logits of :data:`PLACES` at a stride of :data:`FINE_PX`."""
    knob: Float[Tensor, "B h w"]
    """Logit that a grip is a knob."""
    lift: Float[Tensor, "B h w"]
    """Logit that one takes hold of it to lift the whole thing."""
    extent: Float[Tensor, "B 4 h w"]
    """From a cell's centre to the left, upper, right and lower edges of the grip there, pixels."""
    longer: Float[Tensor, "B m n"]
    """Logit of longer grips at a stride of :data:`MIDDLE_PX`."""
    longer_extent: Float[Tensor, "B 4 m n"]
    """As ``extent``, of longer grips; negative where the cell's centre lies beside a thin one."""
    longest: Float[Tensor, "B H W"]
    """Logit of the longest grips at a stride of :data:`COARSE_PX`."""
    longest_extent: Float[Tensor, "B 4 H W"]
    """As ``longer_extent``."""
    panel: Float[Tensor, "B Q H W"]
    """Logits of :data:`PANELS` at a stride of :data:`COARSE_PX`."""
    panel_extent: Float[Tensor, "B 4 H W"]
    """As ``extent``, of the panel."""
    opening: Float[Tensor, "B O H W"]
    """Logits of :data:`OPENINGS`, which exclude each other."""
    features: Float[Tensor, "B C h w"]
    """What the second looks see, at a stride of :data:`FINE_PX` ..."""
    deep_features: Float[Tensor, "B D H W"]
    """... and at one of :data:`COARSE_PX`."""


class _Mix(nn.Module):
    """A 3 x 3 convolution, normalised."""

    def __init__(self, inputs: int, outputs: int, *, step: int = 1) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, 3, padding=step, dilation=step, bias=False)
        self.norm = nn.GroupNorm(_GROUPS, outputs)

    def forward(self, x: Float[Tensor, "B C H W"]) -> Float[Tensor, "B D H W"]:
        return F.relu(self.norm(self.conv(x)), inplace=True)


def _onto(map: Float[Tensor, "B C h w"], other: Float[Tensor, "B C _ _"]) -> Float[Tensor, "B C h w"]:
    """Another map at the size of a map."""
    return F.interpolate(other, map.shape[-2:], mode="bilinear", align_corners=False)


class _Head(nn.Module):
    """Maps of one level, and extents in units of its stride, which never are negative."""

    def __init__(self, width: int, scores: int, *, rare: int, stride: int) -> None:
        super().__init__()
        self.mix = _Mix(width, width)
        self.score = nn.Conv2d(width, scores, 1)
        self.extent = nn.Conv2d(width, 4, 1)
        self.stride = stride
        nn.init.constant_(self.score.bias[:rare], _RARE)  # type: ignore[index]
        nn.init.constant_(self.extent.bias, 1.0)  # type: ignore[arg-type]

    def forward(self, x: Float[Tensor, "B C H W"]) -> tuple[Float[Tensor, "B S H W"], Float[Tensor, "B 4 H W"]]:
        x = self.mix(x)
        return self.score(x).float(), self.stride * self.extent(x).float().clamp(-3, 6).exp()


class _LongHead(_Head):
    """A map of one score, and extents by the place and size of the box."""

    def __init__(self, width: int, *, stride: int) -> None:
        super().__init__(width, 1, rare=1, stride=stride)

    def forward(self, x: Float[Tensor, "B C H W"]) -> tuple[Float[Tensor, "B S H W"], Float[Tensor, "B 4 H W"]]:
        x = self.mix(x)
        shift, half = self.extent(x).float().chunk(2, dim=1)
        half = half.clamp(-3, 6).exp()
        return self.score(x).float(), self.stride * torch.cat((half - shift, half + shift), dim=1)


class FinderNetwork(nn.Module):
    """Pictures to maps of what is found.

    Args:
        config: its shape.
    """

    def __init__(self, config: FinderConfig) -> None:
        super().__init__()
        self.config = config
        self.encoder = Encoder(config.encoder).requires_grad_(requires_grad=False)
        self.detail = EfficientNet()
        width, deep, context = config.width, config.deep_width, len(CONTEXT_BLOCKS) * config.encoder.width
        self.lateral = nn.ModuleList(
            nn.Conv2d(channels, deep if i > 1 else width, 1) for i, channels in enumerate(WIDTHS)
        )
        self.context = nn.Conv2d(context, deep, 1)
        self.deep = nn.ModuleList(_Mix(deep, deep, step=step) for step in _STEPS)
        self.down = nn.Conv2d(deep, width, 1)
        self.mix = nn.ModuleList(_Mix(width, width) for _ in range(2))
        self.around = nn.ModuleList(_Mix(width, width, step=step) for step in _MIDDLE_STEPS)
        self.fine = _Head(width, len(PLACES) + 2, rare=len(PLACES), stride=FINE_PX)
        self.coarse = _Head(deep, len(PANELS) + len(OPENINGS), rare=len(PANELS), stride=COARSE_PX)
        self.longer, self.longest = _LongHead(width, stride=MIDDLE_PX), _LongHead(deep, stride=COARSE_PX)
        self.second = SecondLooks((width, deep), strides=(FINE_PX, COARSE_PX))
        self.dropout = nn.Dropout2d(0.1)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # twice as fast on processors

    def busiest(self) -> list[nn.Module]:
        """The parts that do most of the work, for which it pays to be compiled."""
        return [self.detail, self.fine, self.coarse]

    def context_of(self, rgb: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B E r c"]:
        """What the vision transformer sees in pictures, in rows and columns."""
        patch = self.config.encoder.patch_size
        part, whole = CONTEXT_SHARE  # in whole numbers, because an exported graph cannot round a size
        size = [max(1, (2 * part * side + whole * patch) // (2 * whole * patch)) * patch for side in rgb.shape[-2:]]
        small = F.interpolate(rgb, size, mode="bilinear", align_corners=False, antialias=True)
        return self.encoder.depths(small, CONTEXT_BLOCKS)

    def forward(self, rgb: Float[Tensor, "B 3 H W"], *, context: Float[Tensor, "B E r c"] | None = None) -> FinderMaps:
        """The maps.

        Args:
            rgb: colours from 0 to 1; sides are multiples of 32.
            context: of the pictures, where it is known already.
        """
        rgb = rgb.contiguous(memory_format=torch.channels_last)
        tokens = self.context_of(rgb) if context is None else context
        fine, middle, deep, deepest = (lateral(x) for lateral, x in zip(self.lateral, self.detail(rgb), strict=True))
        deep = deep + _onto(deep, deepest) + _onto(deep, self.context(self.dropout(tokens)))
        for mix in self.deep:
            deep = deep + mix(deep)
        middle = self.mix[0](middle + _onto(middle, self.down(deep)))
        for mix in self.around:
            middle = middle + mix(middle)
        fine = self.mix[1](fine + _onto(fine, middle))
        place, extent = self.fine(fine)
        (longer, longer_extent), (longest, longest_extent) = self.longer(middle), self.longest(deep)
        panel, panel_extent = self.coarse(deep)
        places, knob, lift = place.split((len(PLACES), 1, 1), dim=1)
        panels, opening = panel.split((len(PANELS), len(OPENINGS)), dim=1)
        return FinderMaps(
            places, knob[:, 0], lift[:, 0], extent, longer[:, 0], longer_extent, longest[:, 0], longest_extent, panels,
            panel_extent, opening, fine.float(), deep.float(),
        )  # fmt: skip
