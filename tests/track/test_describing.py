"""Descriptors that are made beside the filter."""

from __future__ import annotations

import numpy as np
import torch

from quest.model.xfeat import XFeat
from quest.track.describing import Describer, described
from tests.filter.scenes import texture


def test_descriptors_are_the_same_in_a_thread_and_threads_elsewhere_stay_as_they_are() -> None:
    features, grey, threads = XFeat.from_package(), texture(160, 96, seed=0), torch.get_num_threads()
    describe = Describer(features).begin(grey)
    np.testing.assert_allclose(describe(), described(features, grey).descriptors, atol=1e-6)
    assert torch.get_num_threads() == threads
