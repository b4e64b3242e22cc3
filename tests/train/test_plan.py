"""Plans of batches: parts of one are what the whole is."""

from __future__ import annotations

import json
from dataclasses import fields
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import torch

from quest.errors import ConfigError
from quest.train.batches import stream_batches
from quest.train.devices import divide
from quest.train.windows import WindowSampler
from tests.paper.tiny import make_paper
from tests.tolerances import EXACT
from tests.train.prepared import make_sampler


@pytest.fixture(scope="module")
def sampler(tmp_path_factory: pytest.TempPathFactory) -> WindowSampler:
    return make_sampler(tmp_path_factory.mktemp("plan"), make_paper(), batch=6)


def assert_same(parts: list, whole: object) -> None:
    for f in fields(whole):  # type: ignore[arg-type]
        joined = torch.cat([getattr(part, f.name) for part in parts])
        torch.testing.assert_close(joined, getattr(whole, f.name), **EXACT, equal_nan=True)


@pytest.mark.parametrize(("processes", "accumulate"), [(1, 1), (2, 1), (1, 3), (3, 2)])
def test_parts_are_the_whole(sampler: WindowSampler, processes: int, accumulate: int):
    whole = sampler.draw(np.random.default_rng(0))
    plan = sampler.plan(np.random.default_rng(0))
    slices = [divide(6, rank=r, processes=processes, accumulate=accumulate) for r in range(processes)]
    ordered = sorted((s for own in slices for s in own), key=lambda s: s.start)
    loaded = [sampler.load(plan.part(s)) for s in ordered]
    assert_same([frames for frames, _ in loaded], whole[0])
    assert_same([truth for _, truth in loaded], whole[1])


def test_a_batch_is_divided_evenly_or_not_at_all():
    assert divide(8, rank=1, processes=2, accumulate=2) == [slice(2, 4), slice(6, 8)]
    with pytest.raises(ConfigError, match="multiple of 6"):
        divide(8, rank=0, processes=3, accumulate=2)


@pytest.mark.parametrize("readers", [0, 2])
def test_reading_ahead_changes_nothing(sampler: WindowSampler, readers: int):
    """Batches come in the generator's order, each with the state from which the next one is drawn."""
    rng, plain = np.random.default_rng(1), np.random.default_rng(1)
    batches = stream_batches(sampler, rng, [slice(0, 6)], readers=readers)
    for batch in islice(batches, 3):
        frames, truth = sampler.draw(plain)
        assert_same([batch.parts[0].frames], frames)
        assert_same([batch.parts[0].truth], truth)
        assert json.loads(batch.rng) == plain.bit_generator.state


def test_what_goes_wrong_while_reading_ahead_comes_out(sampler: WindowSampler, monkeypatch: pytest.MonkeyPatch):
    def broken(plan: object) -> None:
        raise FileNotFoundError(Path("features.npy"))

    monkeypatch.setattr(sampler, "load", broken)
    with pytest.raises(FileNotFoundError):
        next(stream_batches(sampler, np.random.default_rng(0), [slice(0, 6)], readers=1))


def test_the_truth_of_flow(sampler: WindowSampler):
    """The next frame's position minus the newest one's, in the reference axes; NaN where the view ends."""
    rng, ended, moved = np.random.default_rng(2), 0, 0
    for _ in range(6):
        plan = sampler.plan(rng, disturb=False)
        frames, truth = sampler.load(plan)
        for b, ((view, index), following) in enumerate(zip(plan.picks, plan.following, strict=True)):
            k = view.visible.shape[1]
            if following < 0:
                assert truth.flow[b].isnan().all()
                ended += 1
                continue
            step_m = np.linalg.norm(view.point_world[following] - view.point_world[index[-1]], axis=-1)
            assert (truth.flow[b, :k].norm(dim=-1) * frames.scale[b]).numpy() == pytest.approx(step_m, abs=1e-5)
            moved += int((step_m > 0.01).sum())
    assert ended
    assert moved
