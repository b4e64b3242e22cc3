"""Dense descriptors of pictures, made in the background while the filter follows what moves.

The filter is hundreds of small operations, which no second core makes faster; the network is one large one. They need
each other late in a frame, so each gets a core.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from threadpoolctl import ThreadpoolController

from quest.filter.picture import Picture
from quest.model.xfeat import XFeat

_LIBRARIES = ThreadpoolController()


class Describer:
    """A network of descriptors in a thread, which ends with the describer."""

    def __init__(self, features: XFeat) -> None:
        self._features = features
        self._pool = ThreadPoolExecutor(1, "quest-describer", _leave_a_core)

    def begin(self, grey: UInt8[np.ndarray, "H W"]) -> Callable[[], Float32[np.ndarray, "D h w"]]:
        """Begin with a picture; what is returned waits for its descriptors."""
        described: Future[Float32[np.ndarray, "D h w"]] = self._pool.submit(_describe, self._features, grey)
        return described.result


def described(features: XFeat, grey: UInt8[np.ndarray, "H W"]) -> Picture:
    """A picture with its descriptors, made at once."""
    return Picture(grey, _describe(features, grey))


@torch.inference_mode()
def _describe(features: XFeat, grey: UInt8[np.ndarray, "H W"]) -> Float32[np.ndarray, "D h w"]:
    device = next(features.parameters()).device
    return features.features(torch.from_numpy(grey).to(device))[0].float().cpu().numpy()


def _leave_a_core() -> None:
    """Let PyTorch use one thread less here. Its own setting would also change it for threads that begin later."""
    allowed = torch.get_num_threads()  # before the limit: PyTorch sets its number when it is first asked in a thread
    _LIBRARIES.limit(limits=max(1, allowed - 1), user_api="openmp")
