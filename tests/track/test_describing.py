"""Descriptors that are made beside the filter."""

from __future__ import annotations

import numpy as np
import torch

import quest
from quest.data.recording import read_recording
from quest.data.sample import sample_folder
from quest.model.xfeat import XFeat
from quest.track.describing import Describer, described
from tests.filter.scenes import texture
from tests.golden.streams import cut


def test_descriptors_are_the_same_in_a_thread_and_threads_elsewhere_stay_as_they_are() -> None:
    features, grey, threads = XFeat.from_package(), texture(160, 96, seed=0), torch.get_num_threads()
    describe = Describer(features).begin(grey)
    np.testing.assert_allclose(describe(), described(features, grey).descriptors, atol=1e-6)
    assert torch.get_num_threads() == threads


def test_networks_in_half_precision_say_nearly_the_same() -> None:
    clip = cut(read_recording(sample_folder()), slice(0, 4))
    exact, half = (quest.load(engine=engine, monitor=False).track(clip) for engine in ("torch", "bfloat16"))
    assert half.names == exact.names
    np.testing.assert_allclose(half.uv_px, exact.uv_px, atol=1)
