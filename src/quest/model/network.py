"""The assembled network: encoder, observer, queries, decoder, heads."""

from __future__ import annotations

from typing import Generic, TypeVar

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor, nn

from quest.errors import ConfigError
from quest.model.affordance import AffordanceHead, AffordanceMap, AffordanceTrunk
from quest.model.config import DecoderConfig, NetworkConfig
from quest.model.decoder import Anchor, Binder, DecoderLayer, HeatmapHead, Prediction
from quest.model.encoder import Encoder
from quest.model.flow_head import FlowHead
from quest.model.joint_head import JointHead
from quest.model.observation import FrameBatch, Observation, Observer
from quest.model.pieces import PieceHead
from quest.types import INTENTS, LABELS

UNKNOWN_LABEL = len(LABELS)
"""Index of the label embedding that stands for "not told"."""

UNKNOWN_INTENT = len(INTENTS)
"""The same of the intent embedding."""


C = TypeVar("C", bound=DecoderConfig, covariant=True)


class WindowNetwork(nn.Module, Generic[C]):
    """A frozen encoder, and what is trained to answer for entities in windows of frames.

    Attributes:
        config: its shapes.
        encoder: of images.
        flow: head that stage 2 trains; None without.
    """

    flow: FlowHead | None

    def __init__(self, config: C) -> None:
        super().__init__()
        self.config = config
        self.encoder = Encoder(config.encoder)

    def encode(self, rgb: UInt8[Tensor, "B H W 3"]) -> Float[Tensor, "B N E"]:
        """Tokens of letterboxed images; frozen while the decoder trains, so they can be cached."""
        return self.encoder(rgb)

    def displace(self, embedding: Float[Tensor, "B T K D"], point: Float[Tensor, "B T K 3"]) -> Float[Tensor, "B K 3"]:
        """Displacement of every query from the window's newest frame to the next, in units of the reference frame.

        Args:
            embedding: the queries after the decoder, oldest frame first.
            point: their lifted points.

        Raises:
            ConfigError: the network has no flow head.
        """
        if self.flow is None:
            raise ConfigError("network: these weights have no flow head; `quest train --stage 2` adds one")
        return self.flow(embedding, point)

    def trainable(self) -> list[nn.Parameter]:
        """Parameters of stage 1."""
        raise NotImplementedError

    def busiest(self) -> list[nn.Module]:
        """The parts that do most of the work, for which it pays to be compiled."""
        raise NotImplementedError


class QuestNetwork(WindowNetwork[NetworkConfig]):
    """Entities of a window of RGB-D frames, one answer per query and frame.

    Use :meth:`encode` and :meth:`observe` once per frame, :meth:`bind` once per query and :meth:`decode` per window.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        self.observer = Observer(config)
        self.layers = nn.ModuleList(DecoderLayer(config.width, config.heads) for _ in range(config.decoder_layers))
        self.norm = nn.LayerNorm(config.width)
        self.age = nn.Parameter(0.02 * torch.randn(config.window, config.width))
        """Code of time: how old a frame is."""
        self.head = HeatmapHead(config)
        self.binder = Binder(config)
        self.joint = JointHead(config.width)
        self.affordance = AffordanceHead(config)
        self.affordance_trunk = AffordanceTrunk(config) if config.map_layers else None
        self.affordance_pieces = PieceHead() if config.pieces else None
        self.flow = FlowHead(config.width, window=config.window, points3d=config.points3d) if config.flow else None

    def enlarge(self, rgb: UInt8[Tensor, "B H W 3"]) -> Float[Tensor, "B C E"]:
        """Tokens of letterboxed images at twice their size, one per cell, from which the affordance map is read."""
        return self.encoder(rgb, enlarge=2)

    def observe(self, frames: FrameBatch) -> Observation:
        """What the decoder and the binder look at."""
        return self.observer(frames)

    def bind(
        self,
        observed: Observation,
        uv: Float[Tensor, "B K 2"],
        point: Float[Tensor, "B K 3"],
        label: Int[Tensor, "B K"],
        valid: Bool[Tensor, "B K"],
        intent: Int[Tensor, "B K"] | None = None,
    ) -> Anchor:
        """Bind queries to pixels of one frame (see :class:`Binder`); an intent of None is told of none."""
        intent = torch.full_like(label, UNKNOWN_INTENT) if intent is None else intent
        content = self.binder(observed, uv, point, label, intent)
        return Anchor(content, self.head.look.template(observed, uv), valid)

    def afford(self, frames: FrameBatch, observed: Observation | None = None) -> AffordanceMap:
        """What could be taken hold of in every frame, from which discovery starts.

        Args:
            frames: the frames.
            observed: the same frames as observed; None to observe them here, if the map has no trunk that does.
        """
        if self.affordance_trunk is None:
            return self.affordance((self.observe(frames) if observed is None else observed).fine)
        enlarged = frames.enlarged
        if enlarged is None:
            with torch.no_grad():
                enlarged = self.enlarge(frames.rgb.flatten(0, 1)).unflatten(0, frames.rgb.shape[:2])
        return self.affordance(self.affordance_trunk(frames, enlarged))

    def embed(self, anchor: Anchor, observed: Observation) -> Float[Tensor, "B T K D"]:
        """The queries after they looked at every frame of the window, oldest first."""
        x = anchor.content[:, None] + self.age[-observed.tokens.shape[1] :, None]
        for layer in self.layers:
            x = layer(x, observed.tokens, anchor.valid)
        return self.norm(x)

    def decode(self, anchor: Anchor, observed: Observation) -> Prediction:
        """Answers for every frame of the window; the last is the causal answer for the newest frame."""
        return self.head(self.embed(anchor, observed), anchor, observed)

    def trainable(self) -> list[nn.Parameter]:
        """Parameters of stage 1: all but the encoder, the flow head, what ranks pieces, and a map with a trunk."""
        others = "affordance_pieces" if self.config.map_layers == 0 else "affordance"
        return [p for name, p in self.named_parameters() if not name.startswith(("encoder.", "flow.", others))]

    def busiest(self) -> list[nn.Module]:
        """Observer and decoder; binding and heads branch too much to gain by being compiled."""
        return [self.observer, *self.layers]
