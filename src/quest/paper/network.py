"""The published network: learned queries look at every frame of a window and answer with coordinates.

    colours  B T 224 224 3          depth  B T 224 224
        |                               |
    encoder, frozen: 16 x 16 patches    |
        |                               |
    features  B T N=196 E               |
        |                               |
    project + code of place  N D        |
            + code of time   T D        |
        |                               |
    tokens F_t  B T N D=384             |
        |                               |
        |     learned queries  K=8 D, the same in every frame
        |        |                      |
    decoder, 2 layers of 4 heads:       |
        queries look at F_t             |
        queries look at each other      |
        a query looks at itself in earlier frames
        MLP                             |
        |                               |
    embedding  B T K D                  |
        |           |            |      |
    MLP head      labels      flow head (stage 2)
        |         B T K L      B K 3    |
    (x, y)  B T K 2, confidence  B T K  |
        |                               |
        +------------ lifting ----------+
                         |
                  point  B T K 3, reference frame

Coordinates come out of the MLP alone, as published, or are the mean place of what a query last looked at, which the MLP
corrects (``place_from``).

The publication does not say how queries know of the rest of the window but for the codes of time; here a query also
looks at itself in the window's earlier frames, which keeps the answer for t causal. It has no labels either; the
protocol that gives no point asks for them, so a linear layer tells them.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int, UInt8
from torch import Tensor, nn

from quest.errors import ConfigError, WeightsError
from quest.model.config import NetworkConfig
from quest.model.encoder import Encoder, read_into
from quest.model.frames import FrameBatch
from quest.model.tensor_file import fetch_shared, read_tensors, save_half
from quest.model.weights import shipped_weights
from quest.paper.decoder import DecoderLayer, Tokens
from quest.types import LABELS
from quest.untrusted import reading

FORMAT = "quest-paper-1"
REST = 0.003
"""Displacements shorter than this, in units of the reference frame, are answered as 0."""


@dataclass(frozen=True, kw_only=True)
class PaperConfig(NetworkConfig):
    """Shapes of the published network; the defaults are the published ones."""

    window: int = 4
    """T, frames that the decoder sees together."""
    cell_px: int = 8
    """Side of the cells over whose depths the reference frame takes its median, pixels of the network's input."""
    width: int = 384
    """Channels inside the decoder."""
    heads: int = 4
    """Attention heads of the decoder."""
    decoder_layers: int = 2
    """Layers of the decoder."""
    slots: int = 8
    """K, learned queries."""
    place_from: Literal["mlp", "map"] = "mlp"
    """Where coordinates come from: the MLP, as published, or the last attention map of the first head."""
    flow: bool = False
    """Whether there is a flow head, which stage 2 trains."""

    def __post_init__(self) -> None:
        if self.width % self.heads:
            raise ConfigError(f"network: width {self.width} must be a multiple of heads {self.heads}")
        if self.encoder.image_size % self.encoder.patch_size or self.encoder.width % self.encoder.heads:
            raise ConfigError(
                f"network: expected whole patches and a width that is a multiple of heads, got {self.encoder}"
            )
        if min(self.cell_px, self.window, self.slots, self.decoder_layers) < 1:
            raise ConfigError("network: cell_px, window, slots and decoder_layers must be at least 1")
        if self.encoder.image_size % self.cell_px:
            raise ConfigError(f"network: expected whole cells of {self.cell_px} px in {self.encoder.image_size} px")
        if self.place_from not in ("mlp", "map"):
            raise ConfigError(f"network: expected place_from mlp or map, got {self.place_from!r}")


@dataclass(frozen=True)
class Decoded:
    """Queries after a layer of the decoder."""

    embedding: Float[Tensor, "B T K D"]
    """What they are."""
    where: Float[Tensor, "B T K N"]
    """Attention of the layer's first head on the tokens of each frame."""


@dataclass(frozen=True)
class SlotAnswers:
    """Answers of K slots in every frame of a window."""

    embedding: Float[Tensor, "B T K D"]
    """The queries after the decoder."""
    uv: Float[Tensor, "B T K 2"]
    """Coordinates in [0, 1]^2 of the input; raw, so they may leave it."""
    logit: Float[Tensor, "B T K"]
    """Confidence that there is an entity and that it is seen, log odds."""
    label_logits: Float[Tensor, "B T K L"]
    """What each takes its entity for, index into LABELS."""
    point: Float[Tensor, "B T K 3"]
    """Lifted position in the reference frame; NaN where there is no depth."""
    where: Float[Tensor, "B T K N"]
    """Where they looked last (see :class:`Decoded`)."""
    earlier_uv: Float[Tensor, "B T K M 2"]
    """Coordinates after each of M earlier layers, for training."""

    def then(self, later: SlotAnswers) -> SlotAnswers:
        """These frames and later ones."""
        return SlotAnswers(*(torch.cat((getattr(self, f.name), getattr(later, f.name)), dim=1) for f in fields(self)))

    def of(self, slot: Int[Tensor, "B E"]) -> SlotAnswers:
        """The answers of one slot per entity."""
        return SlotAnswers(*(_gather(getattr(self, f.name), slot) for f in fields(self)))


class FlowHead(nn.Module):
    """Where every query goes next: the 3D displacement from a window's newest frame to the frame after it.

    The frame after it is one step on, and a step is whatever lies between the frames of the window: the head is told of
    no clock. It starts out by saying that nothing moves. Most things rest most of the time, and a head is never quite
    still: what it answers below :data:`REST` is rest, but while it learns.
    """

    def __init__(self, width: int, *, window: int) -> None:
        super().__init__()
        self.window = window
        self.norm = nn.LayerNorm(width)
        self.frame = nn.Linear(width, width)
        self.age = nn.Parameter(0.02 * torch.randn(window, width))
        self.fuse = nn.Linear(window * width, width)
        final = nn.Linear(width, 3)
        self.out = nn.Sequential(nn.GELU(), nn.Linear(width, width), nn.GELU(), final)
        nn.init.zeros_(final.weight)
        nn.init.zeros_(final.bias)

    def forward(self, embedding: Float[Tensor, "B T K D"]) -> Float[Tensor, "B K 3"]:
        """Displacement to the next frame, in units of the reference frame.

        Of a stream's first frames, before there are as many as in a window, the oldest stands for those before it.
        """
        missing = self.window - embedding.shape[1]
        embedding = torch.cat((embedding[:, :1].expand(-1, missing, -1, -1), embedding), dim=1)
        x = F.gelu(self.frame(self.norm(embedding)) + self.age[:, None])
        flow = self.out(self.fuse(x.transpose(1, 2).flatten(2))).float()
        return flow if self.training else torch.where(flow.norm(dim=-1, keepdim=True) < REST, 0.0, flow)


class PaperNetwork(nn.Module):
    """Maps a window of T frames to the answers of K slots in each of them."""

    def __init__(self, config: PaperConfig) -> None:
        super().__init__()
        self.config = config
        self.encoder = Encoder(config.encoder).requires_grad_(requires_grad=False)
        d = config.width
        self.project = nn.Linear(config.encoder.width, d)
        self.place = nn.Parameter(0.02 * torch.randn(config.encoder.grid**2, d))
        self.time = nn.Parameter(0.02 * torch.randn(config.window, d))
        # As large as what they read from the tokens: small ones would drown in it and all answer alike.
        self.queries = nn.Parameter(torch.randn(config.slots, d))
        self.layers = nn.ModuleList(DecoderLayer(d, config.heads) for _ in range(config.decoder_layers))
        self.norm = nn.LayerNorm(d)
        self.head = nn.Sequential(nn.LayerNorm(d), nn.Linear(d, d), nn.GELU(), nn.Linear(d, 3))
        self.label = nn.Linear(d, len(LABELS))
        self.flow = FlowHead(d, window=config.window) if config.flow else None

    def encode(self, rgb: UInt8[Tensor, "B H W 3"]) -> Float[Tensor, "B N E"]:
        """Tokens of letterboxed images; frozen while the rest trains, so they can be cached."""
        return self.encoder(rgb)

    def forward(self, frames: FrameBatch) -> SlotAnswers:
        """Answers for every frame of a window; those for a frame do not depend on later ones."""
        return self.answer(self.embed(frames.features), frames)

    def embed(self, features: Float[Tensor, "B T N E"]) -> list[Decoded]:
        """The queries after they looked at every frame of the window, oldest first.

        Where a clip has fewer frames yet, they are taken for the first ones of a window: what a window answers for its
        i-th frame, it has learned to answer from i frames.

        Returns:
            One for every layer; the last is what answers.
        """
        b, t = features.shape[:2]
        tokens = Tokens(F.layer_norm(features, features.shape[-1:]), self.project, self.place, self.time[:t])
        x, decoded = self.queries.expand(b, t, -1, -1), []
        for layer in self.layers:
            x, where = layer(x, tokens)
            decoded.append(Decoded(self.norm(x), where))
        return decoded

    def answer(self, decoded: list[Decoded], frames: FrameBatch) -> SlotAnswers:
        """What queries say that looked at a window, for the frames that are asked for.

        Of what :meth:`embed` gives, the last layer is enough where nothing is learned.
        """
        last, (*earlier, (uv, logit)) = decoded[-1], [self._read_off(each) for each in decoded]
        uv_px = uv * self.config.encoder.image_size
        point = frames.to_reference(uv_px, frames.depth_at(uv_px))
        earlier_uv = torch.stack([uv, *(uv for uv, _ in earlier)], dim=-2)[..., 1:, :]
        label = self.label(last.embedding).float()
        return SlotAnswers(last.embedding, uv, logit, label, point, last.where.float(), earlier_uv)

    def _read_off(self, decoded: Decoded) -> tuple[Float[Tensor, "B T K 2"], Float[Tensor, "B T K"]]:
        """Coordinates and confidence after a layer."""
        out = self.head(decoded.embedding).float()
        if self.config.place_from == "mlp":
            return out[..., :2] + 0.5, out[..., 2]
        step = (torch.arange(self.config.encoder.grid, device=out.device) + 0.5) / self.config.encoder.grid
        middle = torch.stack(torch.meshgrid(step, step, indexing="xy"), dim=-1).flatten(0, 1)
        return out[..., :2] + decoded.where.float() @ middle, out[..., 2]

    def displace(self, embedding: Float[Tensor, "B T K D"]) -> Float[Tensor, "B K 3"]:
        """As of :class:`FlowHead`, from queries after the decoder, oldest frame first.

        Raises:
            ConfigError: the network has no flow head.
        """
        if self.flow is None:
            raise ConfigError("network: these weights have no flow head; `quest train --stage 2` adds one")
        return self.flow(embedding)

    def trainable(self) -> list[nn.Parameter]:
        """Parameters of stage 1: all but the encoder and the flow head."""
        return [p for name, p in self.named_parameters() if not name.startswith(("encoder.", "flow."))]

    def busiest(self) -> list[nn.Module]:
        """The decoder's layers."""
        return list(self.layers)

    def save(self, path: Path, *, about: str, licence: str = "", beside: Path | None = None) -> None:
        """Write the network in half precision, atomically.

        Args:
            path: safetensors file to write.
            about: where the weights come from, a line for people.
            licence: under which the weights may be used; empty to say nothing.
            beside: file of another network that will lie in the same folder or ships; parts that both have, such as
                blocks of the encoder, are left out and read from there.

        Raises:
            WeightsError: the other network has no part in common, or the file cannot be written.
        """
        words = {"format": FORMAT, "config": self.config.to_json(), "about": about, "licence": licence}
        save_half(self, path, metadata=words, beside=beside)


@dataclass(frozen=True)
class LoadedPaper:
    """A published network read from a file, in evaluation mode, with where its weights come from."""

    network: PaperNetwork
    about: str
    licence: str


def is_paper(path: Path) -> bool:
    """Whether a file of weights holds a published network.

    Raises:
        WeightsError: it is no whole safetensors file.
    """
    return read_tensors(path, parts=())[0].get("format") == FORMAT


def read_paper(path: Path) -> LoadedPaper:
    """Read what :meth:`PaperNetwork.save` wrote.

    Raises:
        WeightsError: the file is corrupt, of another format or shape, or shares parts with one that is not there.
    """
    metadata, state = read_tensors(path)
    if metadata.get("format") != FORMAT:
        raise WeightsError(f"{path}: expected weights of format {FORMAT!r}, got {metadata.get('format')!r}")
    with reading(path, WeightsError, "fetch or train it again"):
        config, about, licence = PaperConfig.from_json(metadata["config"]), metadata["about"], metadata["licence"]
    state |= fetch_shared(path, metadata, shipped_weights())
    state = {name: tensor.float() for name, tensor in state.items()}
    network = read_into(lambda: PaperNetwork(config), state, what=f"weights {path}")
    return LoadedPaper(network.eval(), about, licence)


def _gather(value: Tensor, slot: Int[Tensor, "B E"]) -> Tensor:
    index = slot[:, None].expand(-1, value.shape[1], -1)
    return value.gather(2, index.reshape(*index.shape, *[1] * (value.ndim - 3)).expand(-1, -1, -1, *value.shape[3:]))
