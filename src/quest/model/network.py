"""The assembled network: encoder, observer, queries, decoder, heads."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor, nn

from quest.errors import ConfigError
from quest.model.config import NetworkConfig
from quest.model.decoder import AffordanceHead, Anchor, Binder, DecoderLayer, HeatmapHead, Prediction, RegressionHead
from quest.model.encoder import Encoder
from quest.model.joint_head import JointHead
from quest.model.observation import FrameBatch, Observation, Observer
from quest.types import LABELS

UNKNOWN_LABEL = len(LABELS)
"""Index of the label embedding that stands for "not told"."""


class QuestNetwork(nn.Module):
    """Entities of a window of RGB-D frames, one answer per query and frame.

    Use :meth:`encode` and :meth:`observe` once per frame, :meth:`bind` once per query and :meth:`decode` per window.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.encoder = Encoder(config.encoder)
        self.observer = Observer(config)
        self.layers = nn.ModuleList(DecoderLayer(config) for _ in range(config.decoder_layers))
        self.norm = nn.LayerNorm(config.width)
        self.age = nn.Parameter(0.02 * torch.randn(config.window, config.width))
        if config.queries == "anchored":
            self.head: HeatmapHead | RegressionHead = HeatmapHead(config)
            self.binder = Binder(config)
            self.joint = JointHead(config.width)
            self.affordance = AffordanceHead()
        else:
            self.head = RegressionHead(config)
            self.learned = nn.Parameter(0.02 * torch.randn(config.slots, config.width))
            self.learned_label = nn.Linear(config.width, len(LABELS))

    def encode(self, rgb: UInt8[Tensor, "B H W 3"]) -> Float[Tensor, "B N E"]:
        """Tokens of letterboxed images; frozen while the decoder trains, so they can be cached."""
        return self.encoder(rgb)

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
    ) -> Anchor:
        """Bind queries to pixels of one frame (see :class:`Binder`).

        Raises:
            ConfigError: the network's queries are learned slots, which cannot be bound to a pixel.
        """
        if not isinstance(self.head, HeatmapHead):
            raise ConfigError(f"preset {self.config.preset!r}: learned queries cannot be bound to a pixel")
        content = self.binder(observed, uv, point, label)
        return Anchor(content, self.head.look.template(observed, uv), valid)

    def slots(self, batch: int) -> Anchor:
        """The learned queries, for networks that have them."""
        content = self.learned.expand(batch, -1, -1)
        valid = torch.ones(content.shape[:2], dtype=torch.bool, device=content.device)
        return Anchor(content, content.new_zeros(*content.shape[:2], 0, 0), valid)

    def embed(self, anchor: Anchor, observed: Observation) -> Float[Tensor, "B T K D"]:
        """The queries after they looked at every frame of the window, oldest first."""
        t = observed.tokens.shape[1]
        x = anchor.content[:, None] + self.age[-t:, None]
        for layer in self.layers:
            x = layer(x, observed.tokens, anchor.valid)
        return self.norm(x)

    def decode(self, anchor: Anchor, observed: Observation, frames: FrameBatch) -> Prediction:
        """Answers for every frame of the window; the last is the causal answer for the newest frame."""
        x = self.embed(anchor, observed)
        if isinstance(self.head, HeatmapHead):
            return self.head(x, anchor, observed)
        prediction = self.head(x, observed)
        uv_px = prediction.uv * self.config.encoder.image_size
        return replace(prediction, point=frames.to_reference(uv_px, frames.depth_at(uv_px)))

    def trainable(self) -> list[nn.Parameter]:
        """Parameters outside the encoder."""
        return [p for name, p in self.named_parameters() if not name.startswith("encoder.")]
