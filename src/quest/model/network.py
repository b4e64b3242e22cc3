"""The assembled network: encoder, observer, queries, decoder, heads."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor, nn

from quest.errors import ConfigError
from quest.model.affordance import AffordanceHead, AffordanceMap, AffordanceTrunk
from quest.model.config import NetworkConfig
from quest.model.decoder import Anchor, Binder, DecoderLayer, HeatmapHead, Prediction, RegressionHead
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


class QuestNetwork(nn.Module):
    """Entities of a window of RGB-D frames, one answer per query and frame.

    Use :meth:`encode` and :meth:`observe` once per frame, :meth:`bind` once per query and :meth:`decode` per window.

    Learned queries follow the publication: the same K queries begin in every frame t of the window, attend to its
    tokens F_t, which carry codes of place and time, and to each other. Of how they know of the rest of the window the
    publication says nothing but those codes; here a query also attends to itself in the earlier frames of the window,
    which keeps the answer for t causal.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.encoder = Encoder(config.encoder)
        self.observer = Observer(config)
        self.layers = nn.ModuleList(DecoderLayer(config) for _ in range(config.decoder_layers))
        self.norm = nn.LayerNorm(config.width)
        self.age = nn.Parameter(0.02 * torch.randn(config.window, config.width))
        """Code of time: of anchored queries by how old a frame is, of learned ones' tokens by its place."""
        if config.queries == "anchored":
            self.head: HeatmapHead | RegressionHead = HeatmapHead(config)
            self.binder = Binder(config)
            self.joint = JointHead(config.width)
            self.affordance = AffordanceHead(config)
            self.affordance_trunk = AffordanceTrunk(config) if config.map_layers else None
        else:
            self.head = RegressionHead(config)
            # As large as what they read from the tokens: small ones would drown in it and all answer alike.
            self.learned = nn.Parameter(torch.randn(config.slots, config.width))
        self.affordance_pieces = PieceHead() if config.pieces else None
        self.flow = FlowHead(config) if config.flow else None

    def encode(self, rgb: UInt8[Tensor, "B H W 3"]) -> Float[Tensor, "B N E"]:
        """Tokens of letterboxed images; frozen while the decoder trains, so they can be cached."""
        return self.encoder(rgb)

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
        """Bind queries to pixels of one frame (see :class:`Binder`); an intent of None is told of none.

        Raises:
            ConfigError: the network's queries are learned slots, which cannot be bound to a pixel.
        """
        if not isinstance(self.head, HeatmapHead):
            raise ConfigError(f"preset {self.config.preset!r}: learned queries cannot be bound to a pixel")
        intent = torch.full_like(label, UNKNOWN_INTENT) if intent is None else intent
        content = self.binder(observed, uv, point, label, intent)
        return Anchor(content, self.head.look.template(observed, uv), valid)

    def afford(self, frames: FrameBatch, observed: Observation | None = None) -> AffordanceMap:
        """What could be taken hold of in every frame, from which discovery starts.

        Args:
            frames: the frames.
            observed: the same frames as observed; None to observe them here, if the map has no trunk that does.

        Raises:
            ConfigError: the network's queries are learned slots, which need no map.
        """
        if not isinstance(self.head, HeatmapHead):
            raise ConfigError(f"preset {self.config.preset!r}: learned queries have no affordance map")
        if self.affordance_trunk is None:
            return self.affordance((self.observe(frames) if observed is None else observed).fine)
        enlarged = frames.enlarged
        if enlarged is None:
            with torch.no_grad():
                enlarged = self.enlarge(frames.rgb.flatten(0, 1)).unflatten(0, frames.rgb.shape[:2])
        return self.affordance(self.affordance_trunk(frames, enlarged))

    def slots(self, batch: int) -> Anchor:
        """The learned queries, for networks that have them."""
        content = self.learned.expand(batch, -1, -1)
        valid = torch.ones(content.shape[:2], dtype=torch.bool, device=content.device)
        return Anchor(content, content.new_zeros(*content.shape[:2], 0, 0), valid)

    def embed(self, anchor: Anchor, observed: Observation) -> Float[Tensor, "B T K D"]:
        """The queries after they looked at every frame of the window, oldest first.

        Where a stream has fewer frames yet, learned queries take them for the first ones of a window: what a window
        answers for its i-th frame, it has learned to answer from i frames.
        """
        t, tokens = observed.tokens.shape[1], observed.tokens
        if self.config.queries == "anchored":
            x = anchor.content[:, None] + self.age[-t:, None]
        else:
            x, tokens = anchor.content[:, None].expand(-1, t, -1, -1), tokens + self.age[:t, None]
        for layer in self.layers:
            x = layer(x, tokens, anchor.valid)
        return self.norm(x)

    def decode(self, anchor: Anchor, observed: Observation, frames: FrameBatch) -> Prediction:
        """Answers for every frame of the window; the last is the causal answer for the newest frame."""
        return self.answer(self.embed(anchor, observed), anchor, observed, frames)

    def answer(
        self, x: Float[Tensor, "B T K D"], anchor: Anchor, observed: Observation, frames: FrameBatch
    ) -> Prediction:
        """Answers of queries that looked at the window, for all its frames or some.

        Args:
            x: from :meth:`embed`.
            anchor: what the queries are bound to.
            observed: the frames that are asked for, as observed.
            frames: the same frames.
        """
        if isinstance(self.head, HeatmapHead):
            return self.head(x, anchor, observed)
        prediction = self.head(x)
        uv_px = prediction.uv * self.config.encoder.image_size
        return replace(prediction, point=frames.to_reference(uv_px, frames.depth_at(uv_px)))

    def labels(self, prediction: Prediction) -> Float[Tensor, "B T K L"]:
        """What learned queries take their entities for in every frame: a score per label.

        Raises:
            ConfigError: the network's queries are anchored, so that discovery knows their labels.
        """
        if isinstance(self.head, HeatmapHead):
            raise ConfigError(f"preset {self.config.preset!r}: anchored queries do not tell labels, discovery does")
        return self.head.labels(prediction.embedding)

    def displace(self, prediction: Prediction) -> Float[Tensor, "B K 3"]:
        """Displacement of every query from the window's newest frame to the next, in units of the reference frame.

        Raises:
            ConfigError: the network has no flow head.
        """
        if self.flow is None:
            raise ConfigError("network: these weights have no flow head; `quest train --stage 2` adds one")
        return self.flow(prediction.embedding, prediction.point)

    def trainable(self) -> list[nn.Parameter]:
        """Parameters of stage 1: all but the encoder, the flow head, what ranks pieces, and a map with a trunk."""
        others = "affordance_pieces" if self.config.map_layers == 0 else "affordance"
        return [p for name, p in self.named_parameters() if not name.startswith(("encoder.", "flow.", others))]
