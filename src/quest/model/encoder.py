"""The image encoder: a plain vision transformer on 16 x 16 patches.

Reference: Dosovitskiy et al., An Image is Worth 16x16 Words, ICLR 2021; layer scale and initial weights
follow Oquab et al., DINOv2, TMLR 2024.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from quest.errors import ConfigError, WeightsError
from quest.untrusted import reading

_MEAN = (0.485, 0.456, 0.406)
_STD = (0.229, 0.224, 0.225)
_MOST_SIZE, _MOST_DEPTH = 2**14, 1024
_Module = TypeVar("_Module", bound=nn.Module)


@dataclass(frozen=True)
class EncoderConfig:
    """Shape of the encoder."""

    image_size: int = 224
    """Side of the square input, pixels."""
    patch_size: int = 16
    """Side of a patch, pixels."""
    width: int = 384
    """Channels D of a token."""
    depth: int = 12
    """Number of transformer blocks."""
    heads: int = 6
    """Attention heads."""

    def __post_init__(self) -> None:
        sizes = (self.image_size, self.patch_size, self.width, self.heads)
        if min(sizes) < 1 or max(sizes) > _MOST_SIZE or not 0 <= self.depth <= _MOST_DEPTH:
            raise ConfigError(f"encoder: expected sizes of 1 to {_MOST_SIZE}, blocks to {_MOST_DEPTH}, got {self}")

    @property
    def grid(self) -> int:
        """Patches along one side of the image."""
        return self.image_size // self.patch_size


class Block(nn.Module):
    """Pre-norm transformer block with layer scale."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm1 = nn.LayerNorm(width, eps=1e-6)
        self.qkv = nn.Linear(width, 3 * width)
        self.proj = nn.Linear(width, width)
        self.scale1 = nn.Parameter(torch.ones(width))
        self.norm2 = nn.LayerNorm(width, eps=1e-6)
        self.fc1 = nn.Linear(width, 4 * width)
        self.fc2 = nn.Linear(4 * width, width)
        self.scale2 = nn.Parameter(torch.ones(width))

    def forward(self, x: Float[Tensor, "B N D"]) -> Float[Tensor, "B N D"]:
        """Attention and MLP, each added to its input."""
        b, n, d = x.shape
        qkv = self.qkv(self.norm1(x)).reshape(b, n, 3, self.heads, d // self.heads).permute(2, 0, 3, 1, 4)
        attended = F.scaled_dot_product_attention(qkv[0], qkv[1], qkv[2]).transpose(1, 2).reshape(b, n, d)
        x = x + self.scale1 * self.proj(attended)
        return x + self.scale2 * self.fc2(F.gelu(self.fc1(self.norm2(x))))


class Encoder(nn.Module):
    """Images to patch tokens."""

    mean: Tensor
    std: Tensor

    def __init__(self, config: EncoderConfig) -> None:
        super().__init__()
        self.config = config
        self.patch = nn.Conv2d(3, config.width, config.patch_size, config.patch_size)
        self.class_token = nn.Parameter(torch.zeros(1, 1, config.width))
        self.position = nn.Parameter(nn.init.normal_(torch.empty(1, 1 + config.grid**2, config.width), std=0.02))
        self.blocks = nn.ModuleList(Block(config.width, config.heads) for _ in range(config.depth))
        self.norm = nn.LayerNorm(config.width, eps=1e-6)
        self.register_buffer("mean", torch.tensor(_MEAN).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(_STD).view(1, 3, 1, 1), persistent=False)

    def forward(self, rgb: UInt8[Tensor, "B H W 3"]) -> Float[Tensor, "B N D"]:
        """Tokens of images of the configured size, row by row, without the class token."""
        x, _ = self._embed(rgb.permute(0, 3, 1, 2).to(self.mean.dtype) / 255)
        for block in self.blocks:
            x = block(x)
        return self.norm(x)[:, 1:]

    def depths(self, rgb: Float[Tensor, "B 3 H W"], blocks: Sequence[int]) -> Float[Tensor, "B E r c"]:
        """Tokens after several blocks, each normalised, one after the other in the channels.

        Args:
            rgb: pictures of any size in whole patches, colours from 0 to 1.
            blocks: indices of the blocks, which rise.
        """
        x, grid = self._embed(rgb)
        read = []
        for block in self.blocks[: blocks[-1] + 1]:
            x = block(x)
            read.append(x)
        normed = [F.layer_norm(read[i][:, 1:], x.shape[-1:]) for i in blocks]
        return torch.cat(normed, dim=-1).transpose(1, 2).unflatten(2, grid)

    def _embed(self, rgb: Float[Tensor, "B 3 H W"]) -> tuple[Float[Tensor, "B N D"], tuple[int, int]]:
        """Class token and patches with their places, and how many patches there are down and across."""
        x = self.patch((rgb - self.mean) / self.std)
        grid = (x.shape[-2], x.shape[-1])
        x = torch.cat((self.class_token.expand(len(x), -1, -1), x.flatten(2).transpose(1, 2)), dim=1)
        return x + resize_position(self.position, grid), grid

    def load_initial(self, state: Mapping[str, Tensor]) -> None:
        """Load weights named as in this module; ``patch.weight`` and ``position`` may differ in size and are resized.

        Raises:
            WeightsError: a tensor is missing, unknown, or of a shape that cannot be resized.
        """
        state = dict(state)
        if "patch.weight" not in state or "position" not in state:
            raise WeightsError(
                "encoder weights: expected tensors 'patch.weight' and 'position'; "
                "make the file with `quest weights import-encoder`"
            )
        patch, position = state["patch.weight"], state["position"]
        side = math.isqrt(max(0, position.shape[1] - 1)) if position.ndim == 3 else 0
        if patch.ndim != 4 or patch.shape[2] != patch.shape[3] or side == 0 or side**2 + 1 != position.shape[1]:
            raise WeightsError(
                f"encoder weights: expected a square patch kernel and positions of a square grid, got "
                f"{tuple(patch.shape)} and {tuple(position.shape)}; make the file with `quest weights import-encoder`"
            )
        state["patch.weight"] = resize_patch_kernel(state["patch.weight"], self.config.patch_size)
        state["position"] = resize_position(state["position"], (self.config.grid, self.config.grid))
        load_exactly(self, state, what="encoder weights")


def read_into(make: Callable[[], _Module], state: Mapping[str, Tensor], *, what: str) -> _Module:
    """A network with the weights of a file; nothing is allocated before their shapes are known to fit.

    Raises:
        WeightsError: names or shapes differ from the network's, or no network can be of such a shape.
    """
    with reading(what, WeightsError, "fetch or train them again"):
        with torch.device("meta"), _NoRandomValues():
            _check_shapes(make(), state, what=what)
        with _NoRandomValues():
            module = make()
    load_exactly(module, state, what=what)
    return module


class _NoRandomValues(TorchFunctionMode):
    """Leaves parameters as they were allocated: it takes time to draw values that a file overwrites."""

    def __torch_function__(self, func: Callable, types: object, args: tuple = (), kwargs: dict | None = None) -> object:
        if getattr(func, "__module__", None) == "torch.nn.init":
            return (kwargs or {}).get("tensor", args[0] if args else None)
        return func(*args, **(kwargs or {}))


def load_exactly(module: nn.Module, state: Mapping[str, Tensor], *, what: str) -> None:
    """Load a state dict, naming what does not fit.

    Raises:
        WeightsError: names or shapes differ from the module's.
    """
    _check_shapes(module, state, what=what)
    module.load_state_dict(dict(state))


def _check_shapes(module: nn.Module, state: Mapping[str, Tensor], *, what: str) -> None:
    own = module.state_dict()
    missing, unknown = sorted(own.keys() - state.keys()), sorted(state.keys() - own.keys())
    shapes = [
        f"{k}: expected {tuple(own[k].shape)}, got {tuple(state[k].shape)}"
        for k in own
        if k in state and own[k].shape != state[k].shape
    ]
    if missing or unknown or shapes:
        raise WeightsError(
            f"{what} do not fit this network: missing {missing[:3]}, unknown {unknown[:3]}, shapes {shapes[:3]}; "
            "use the preset that the weights were made with"
        )


def resize_position(position: Float[Tensor, "1 M D"], grid: tuple[int, int]) -> Float[Tensor, "1 N D"]:
    """Position code (class token first) of a square grid on one of other rows and columns, bicubic."""
    head, rest = position[:, :1], position[:, 1:]
    side = round(rest.shape[1] ** 0.5)
    if (side, side) == grid:
        return position
    square = rest.reshape(1, side, side, -1).permute(0, 3, 1, 2)
    square = F.interpolate(square, size=grid, mode="bicubic", align_corners=False)
    return torch.cat((head, square.permute(0, 2, 3, 1).flatten(1, 2)), dim=1)


def resize_patch_kernel(kernel: Float[Tensor, "D 3 P P"], size: int) -> Float[Tensor, "D 3 Q Q"]:
    """Patch kernel for another patch size, by the pseudo-inverse of image resizing.

    Reference: Beyer et al., FlexiViT, CVPR 2023, section 3.4.
    """
    old = kernel.shape[-1]
    if old == size:
        return kernel
    basis = torch.eye(old * old, dtype=torch.float64).reshape(old * old, 1, old, old)
    resize = F.interpolate(basis, size=(size, size), mode="bicubic", align_corners=False).reshape(old * old, -1)
    flat = kernel.double().reshape(kernel.shape[0], 3, -1)
    # Find the new kernel w' whose answer to a resized patch is the old kernel's answer to the patch.
    resized = flat @ torch.linalg.pinv(resize).T
    return resized.reshape(kernel.shape[0], 3, size, size).to(kernel.dtype)
