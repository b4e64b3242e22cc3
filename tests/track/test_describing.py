"""Descriptors that are made beside the filter."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import torch

import quest
from quest.data.cut import cut_clip
from quest.data.recording import read_recording
from quest.data.sample import sample_folder
from quest.model.xfeat import XFeat
from quest.track.describing import Describer, described
from tests.filter.scenes import texture


class Counting(XFeat):
    """Notes how many threads PyTorch may use where it runs."""

    threads = 0

    def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        self.threads = torch.get_num_threads()
        return super().forward(image)


@pytest.fixture
def three_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("three_threads")
def test_descriptors_are_the_same_in_a_thread_that_leaves_one_to_the_filter() -> None:
    features, grey = Counting.from_package(), texture(160, 96, seed=0)
    assert isinstance(features, Counting)
    beside = Describer(features).begin(grey)()
    assert features.threads == 2
    np.testing.assert_allclose(beside, described(features, grey).descriptors, atol=1e-6)
    assert features.threads == 3  # here all is as before


def test_networks_in_half_precision_say_nearly_the_same() -> None:
    clip = cut_clip(read_recording(sample_folder()), slice(0, 4))
    exact, half = (quest.load(engine=engine, monitor=False).track(clip) for engine in ("torch", "bfloat16"))
    assert half.names == exact.names
    np.testing.assert_allclose(half.uv_px, exact.uv_px, atol=1)
