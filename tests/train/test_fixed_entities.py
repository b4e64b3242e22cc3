"""Entities that are fixed in the base: the last joint is not taken for theirs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from quest.data.store import TakeStore
from quest.train import losses
from quest.train.feature_cache import FeatureCache
from quest.types import Entity, Take
from quest.viz.contact_sheet import contact_sheet
from tests.paper.tiny import make_paper
from tests.synthetic import make_take
from tests.train.prepared import CPU


def take_with_fixed_entity() -> Take:
    """A take whose second entity is fixed in the base."""
    take = make_take(frames=4, views=1, entities=2, seed=0)
    first, second = take.info.entities[:2]
    entities = (first, replace(second, link=0, joint=-1))
    return replace(take, info=replace(take.info, entities=entities))


def test_feature_cache_keeps_no_joint_for_what_is_fixed(tmp_path: Path) -> None:
    take, store = take_with_fixed_entity(), TakeStore(tmp_path / "takes")
    store.write(take)
    assert store.read(take.info.name).info.entities[1].fixed
    cache = FeatureCache(tmp_path / "cache", make_paper().encoder)
    tuple(cache.build(store, store.names(), device=CPU))
    (view,) = cache.views([take.info.name])
    assert view.revolute.tolist() == [False, False]
    np.testing.assert_array_equal(view.axis_world[0], take.joint_axis[0, take.info.entities[0].joint])
    assert not view.axis_world[1].any()


def test_contact_sheet_copes() -> None:
    take = take_with_fixed_entity()
    assert contact_sheet(take, columns=2, tile_width_px=64).std() > 0


def test_intent_follows_from_the_joint() -> None:
    rim, handle = Entity("base/rim", "rim", 0, -1), Entity("lid/handle", "handle", 1, 0)
    assert (rim.fixed, rim.intent) == (True, "lift")
    assert (handle.fixed, handle.intent) == (False, "open")


def test_manifold_of_what_is_fixed_is_its_place() -> None:
    rest = torch.tensor([[[0.1, 0.2, 0.3]]])
    point = rest[:, None] + torch.tensor([0.3, 0.0, 0.4])
    loss = losses.manifold_loss(
        point, rest, torch.zeros(1, 1, 6), torch.tensor([[False]]), torch.tensor([2.0]), torch.ones(1, 1, 1) > 0
    )
    assert float(loss) == pytest.approx(0.25)
