"""The published network, small enough for every test."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch

from quest.paper.network import PaperConfig, PaperNetwork
from tests.tiny import ENCODER, shaken

PAPER = PaperConfig(encoder=ENCODER, width=32, heads=2, decoder_layers=1, slots=5)


def make_paper(config: PaperConfig = PAPER, *, seed: int = 0, **changes: Any) -> PaperNetwork:
    """A network in evaluation mode with random weights, none of which is trivial."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network = PaperNetwork(replace(config, **changes))
    return shaken(network, seed=seed)
