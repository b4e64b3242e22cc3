"""Pieces are learned on training objects only, and what is learned finds handles that stand out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from quest.cli.main import main
from quest.data.store import TakeStore
from quest.errors import ConfigError
from quest.evaluation.piece_learning import learn_pieces
from quest.evaluation.selection import SplitPart
from quest.model.weights import load_network, save_network
from quest.types import Take
from tests.synthetic import make_take
from tests.tiny import DEFAULT
from tests.track.clips import make_tracker

SIZE = (128, 128)


def with_handles(take: Take) -> Take:
    """The take with a bump at every entity in the first frame, 2 cm high."""
    views = []
    for view in take.views:
        assert view.clip.depth_m is not None
        depth = view.clip.depth_m.copy()
        for x, y in view.uv_px[0]:
            near = depth[0, int(y) - 3 : int(y) + 4, int(x) - 6 : int(x) + 7]
            near[near > 0] -= 0.02
        views.append(replace(view, clip=replace(view.clip, depth_m=depth)))
    return replace(take, views=tuple(views))


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> TakeStore:
    store = TakeStore(tmp_path_factory.mktemp("takes"))
    for seed in range(3):
        take = make_take(frames=4, views=2, entities=2, size=SIZE, seed=seed, name=f"panels-{seed}")
        store.write(with_handles(take))
    return store


@pytest.mark.slow
def test_handles_that_stand_out_are_learned(store: TakeStore):
    tracker, told = make_tracker(), []
    takes: dict[str, SplitPart] = dict.fromkeys(store.names(), "train")
    learned = learn_pieces(tracker, [(store, takes)], progress=lambda name, done, of: told.append((done, of)))
    assert told == [(0, 3), (1, 3), (2, 3)]
    assert learned.right == 2 * 2 * 3  # every bump in every view; a view without depth has none
    assert learned.loss < 0.05
    head = learned.network.affordance_pieces
    assert head is not None
    assert np.isfinite([float(tensor.abs().sum()) for tensor in head.state_dict().values()]).all()
    own, before = learned.network.state_dict(), tracker.network.state_dict()
    assert all(torch.equal(own[name], tensor) for name, tensor in before.items())
    again = learn_pieces(make_tracker(), [(store, takes)])
    assert again.loss == learned.loss


def test_only_training_objects_teach(store: TakeStore):
    with pytest.raises(ConfigError, match="training objects only"):
        learn_pieces(make_tracker(), [(store, {"panels-0": "validation"})])


def test_nothing_to_learn_from_is_said(tmp_path: Path):
    store = TakeStore(tmp_path)
    store.write(make_take(frames=4, views=1, entities=2, size=SIZE, name="panels-0"))
    with pytest.raises(ConfigError, match="stands out"):
        learn_pieces(make_tracker(), [(store, {"panels-0": "train"})])


def test_on_the_command_line_the_file_gets_them(store: TakeStore, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    weights = tmp_path / "mine.safetensors"
    tracker = make_tracker()
    save_network(weights, tracker.network, settings="{}", about="mine", licence="MIT")
    assert main(["weights", "pieces", str(weights), "--takes", str(store.root)]) == 0
    assert "learned from" in capsys.readouterr().out
    loaded = load_network(weights)
    assert loaded.network.config == replace(DEFAULT, pieces=True)
    assert (loaded.about, loaded.licence) == ("mine", "MIT")
