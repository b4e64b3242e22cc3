"""Parts of a network that were trained apart, put together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from quest.errors import WeightsError
from quest.model.config import NetworkConfig
from quest.model.network import QuestNetwork
from quest.model.weights import LoadedNetwork

_MAP, _PIECES, _FLOW = "affordance", "affordance_pieces.", "flow."
_UNSAID = "not said for a part of it"
"""What is free in one part does not make the whole free."""


def merge(
    base: LoadedNetwork, *, maps: Sequence[LoadedNetwork] = (), flow: LoadedNetwork | None = None
) -> LoadedNetwork:
    """Weights with the affordance map and the flow head of others.

    The licences of all parts are joined, one that is not said among them; the version is left open.

    The threshold of discovery belongs to one map: choose it anew afterwards (``quest weights tune``). The mean of the
    maps of one training's checkpoints, or of trainings that began with the same map, is often better than each. What
    ranks pieces goes with one map; the mean of several has to learn it anew (``quest weights pieces``).

    Reference: Wortsman et al., Model soups, ICML 2022, section 2, for the mean.

    Args:
        base: what follows entities; everything else is taken from it too.
        maps: whose map to take, the mean if they are several; none to keep the base's.
        flow: whose flow head to take; None to keep the base's.

    Raises:
        WeightsError: a network differs in what its map or flow head rests on.
    """
    config = base.network.config
    state = dict(base.network.state_dict())
    if maps:
        if config.map_layers == 0:
            raise WeightsError(f"{base.name}: its map has no trunk of its own, so it cannot be exchanged")
        for other in maps:
            _check(base, other, apart=lambda name: not name.startswith("encoder."), what="map")
        states = [other.network.state_dict() for other in maps]
        config = replace(config, pieces=len(maps) == 1 and maps[0].network.config.pieces)
        state = {name: tensor for name, tensor in state.items() if not name.startswith(_PIECES)}
        state |= {name: _mean([s[name] for s in states]) for name in state if name.startswith(_MAP)}
        if config.pieces:
            state |= {name: tensor for name, tensor in states[0].items() if name.startswith(_PIECES)}
    if flow is not None:
        if flow.network.flow is None:
            raise WeightsError(f"{flow.name}: expected weights with a flow head (quest train --stage 2), it has none")
        _check(base, flow, apart=lambda name: name.startswith((_MAP, _FLOW)), what="flow head")
        config = replace(config, flow=True)
        state |= {name: tensor for name, tensor in flow.network.state_dict().items() if name.startswith(_FLOW)}
    network = QuestNetwork(config)
    network.load_state_dict(state)
    parts = [f"map of {', '.join(m.name for m in maps)}"] if maps else []
    parts += [f"flow head of {flow.name}"] if flow is not None else []
    licences = dict.fromkeys(part.licence or _UNSAID for part in (base, *maps, flow) if part is not None)
    licence = "" if list(licences) == [_UNSAID] else "; ".join(licences)
    return replace(base, network=network.eval(), about="; ".join([base.about, *parts]), licence=licence, version="")


def _mean(tensors: list[Tensor]) -> Tensor:
    return torch.stack([tensor.double() for tensor in tensors]).mean(dim=0).to(tensors[0].dtype)


def _check(base: LoadedNetwork, other: LoadedNetwork, *, apart: Callable[[str], bool], what: str) -> None:
    """Refuse a network of another shape, or with other weights outside what may differ."""
    if _shape(other) != _shape(base):
        raise WeightsError(f"{other.name}: its network has another shape than that of {base.name}; use weights of one")
    own, theirs = base.network.state_dict(), other.network.state_dict()
    for name, tensor in own.items():
        if not name.startswith(_PIECES) and not apart(name) and not torch.equal(tensor, theirs[name]):
            raise WeightsError(f"{other.name}: its {what} was trained behind another {name} than that of {base.name}")


def _shape(weights: LoadedNetwork) -> NetworkConfig:
    """The configuration without what may differ."""
    return replace(weights.network.config, flow=False, pieces=False)
