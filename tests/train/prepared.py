"""Prepared views of synthetic takes, for the tests of this room."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch

from quest.data.store import TakeStore
from quest.paper.network import PaperNetwork
from quest.train.feature_cache import CachedView, FeatureCache
from quest.train.settings import WindowConfig
from quest.train.windows import WindowSampler
from tests.synthetic import make_take

CPU = torch.device("cpu")


def make_store(root: Path, seeds: Sequence[int], *, frames: int = 12, entities: Sequence[int] = (2, 3)) -> TakeStore:
    """Takes of one view each, with different numbers of entities in turn."""
    store = TakeStore(root)
    for i, seed in enumerate(seeds):
        store.write(make_take(frames=frames, views=1, entities=entities[i % len(entities)], seed=seed, hinges=True))
    return store


def prepare(root: Path, network: PaperNetwork, seeds: Sequence[int], *, frames: int = 12) -> list[CachedView]:
    """Takes in a store, and their features in a cache."""
    store = make_store(root / "takes", seeds, frames=frames)
    cache = FeatureCache(root / "cache", network.encoder)
    list(cache.build(store, store.names(), device=CPU))
    return cache.views(store.names())


def make_sampler(root: Path, network: PaperNetwork, seeds: Sequence[int] = (0, 1), *, batch: int = 4) -> WindowSampler:
    """Windows of synthetic takes."""
    return WindowSampler(prepare(root, network, seeds), network.config, WindowConfig(batch=batch))
