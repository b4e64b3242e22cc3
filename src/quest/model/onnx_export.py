"""The tracker's networks as ONNX: graphs for pictures of any size, and a manifest that says how to use them.

The graphs compute what ``forward`` of :class:`~quest.model.finder.FinderNetwork` and of
:class:`~quest.model.xfeat.XFeat` computes, one picture at a time, in standard operators of one opset.
"""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
import uuid
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from quest.errors import InputError, WeightsError
from quest.extras import DISTRIBUTION, require
from quest.model.finder import COARSE_PX, FINE_PX, OPENINGS, PANELS, PLACES, FinderMaps, FinderNetwork
from quest.model.found import GREY, SIDE_PX, placed
from quest.model.weights import LoadedNetwork
from quest.model.xfeat import PACKAGED, XFeat

FORMAT = "quest-onnx-3"
"""Changes when the graphs or the manifest do, so that none of before is taken for them."""
MANIFEST = "manifest.json"
OPSET = 18
TOLERANCE = 1e-4
"""Largest difference between PyTorch and ONNX Runtime that an export may have."""
_MOST_STEPS = 512
"""Longest side of a picture in steps of :data:`~quest.model.found.SIDE_PX`."""


@dataclass(frozen=True)
class TensorInfo:
    """An input or output of a graph."""

    name: str
    """In the graph."""
    shape: tuple[Any, ...]
    """Numbers, and texts for what depends on the picture."""
    dtype: str
    """Of the elements."""
    unit: str
    """Of the elements."""
    content: str
    """In words; channels in their order."""


@dataclass(frozen=True)
class Graph:
    """An ONNX file."""

    file: str
    """Name in the folder."""
    sha256: str
    """Of the file."""
    weights: str
    """Name of the weights."""
    weights_sha256: str
    """Of the file of weights."""
    licence: str
    """Of the weights."""
    picture: str
    """How the input is made from a picture."""
    inputs: tuple[TensorInfo, ...]
    """In the graph's order."""
    outputs: tuple[TensorInfo, ...]
    """In the graph's order."""


@dataclass(frozen=True)
class Manifest:
    """What a folder of exported networks holds."""

    format: str
    """:data:`FORMAT`."""
    quest: str
    """Version of the package."""
    opset: int
    """Of the operators."""
    settings: dict[str, Any]
    """Settings of the tracker that belong to the finder's weights."""
    finder: Graph
    """The network that finds what can be taken hold of."""
    features: Graph
    """The network of dense descriptors."""


@dataclass(frozen=True)
class Difference:
    """How far PyTorch and ONNX Runtime are apart."""

    network: str
    """Name of the graph."""
    output: str
    """Name of its output."""
    size: tuple[int, int]
    """Width and height of the picture that the network saw, pixels."""
    largest: float
    """Over all elements: absolute, of extents relative to the sides of the box."""


_RGB = TensorInfo("rgb", (1, 3, "H", "W"), "float32", "1", "red, green, blue from 0 to 1")
_GREY = TensorInfo("grey", (1, 1, "H", "W"), "float32", "1", "luminance from 0 to 1")
_FINE, _COARSE, _EIGHTH = (tuple(f"{side}/{px}" for side in "HW") for px in (FINE_PX, COARSE_PX, 8))
_EXTENT = "from a cell's centre to the left, upper, right and lower edge of what is there"
_MAPS = (
    TensorInfo("place", (1, len(PLACES), *_FINE), "float32", "log odds", ", ".join(PLACES)),
    TensorInfo("knob", (1, *_FINE), "float32", "log odds", "a grip there is a knob, no handle"),
    TensorInfo("lift", (1, *_FINE), "float32", "log odds", "it is there to lift the whole thing"),
    TensorInfo("extent", (1, 4, *_FINE), "float32", "pixels of rgb", _EXTENT),
    TensorInfo("longer", (1, *_EIGHTH), "float32", "log odds", "a longer grip"),
    TensorInfo("longer_extent", (1, 4, *_EIGHTH), "float32", "pixels of rgb", _EXTENT),
    TensorInfo("longest", (1, *_COARSE), "float32", "log odds", "a grip of the longest"),
    TensorInfo("longest_extent", (1, 4, *_COARSE), "float32", "pixels of rgb", _EXTENT),
    TensorInfo("panel", (1, len(PANELS), *_COARSE), "float32", "log odds", ", ".join(PANELS)),
    TensorInfo("panel_extent", (1, 4, *_COARSE), "float32", "pixels of rgb", _EXTENT),
    TensorInfo("opening", (1, len(OPENINGS), *_COARSE), "float32", "logits of a softmax", ", ".join(OPENINGS)),
    TensorInfo("features", (1, "C", *_FINE), "float32", "1", "what quest's second look at boxes sees"),
    TensorInfo("deep_features", (1, "D", *_COARSE), "float32", "1", "and what it sees beside these"),
)
_FEATURES = (
    TensorInfo("descriptors", (1, 64, *_EIGHTH), "float32", "1", "descriptors of length 1"),
    TensorInfo("reliability", (1, 1, *_EIGHTH), "float32", "probability", "that a cell can be matched"),
)


def export_networks(loaded: LoadedNetwork, out: Path, *, rgb: UInt8[np.ndarray, "H W 3"]) -> list[Difference]:
    """Write the networks as ONNX, all or nothing, after they were compared with PyTorch.

    Args:
        loaded: the finder and its settings.
        out: folder to write; it must be empty if it is there.
        rgb: a real picture, by which they are compared.

    Returns:
        The differences in the picture as it is, and upright at three fifths of its size.

    Raises:
        InputError: there is something in the folder.
        MissingExtraError: the extra ``export`` is not installed.
        WeightsError: ONNX Runtime computes something else than PyTorch.
    """
    require_empty(out)
    require("onnxruntime")
    settings = json.loads(loaded.settings)
    finder, features = _Maps(loaded.network).eval(), XFeat.from_package()
    out.parent.mkdir(parents=True, exist_ok=True)
    partial = out.with_name(f".{out.name}.partial-{uuid.uuid4().hex[:8]}")
    try:
        partial.mkdir()  # first, because tracing takes its time
        files = {
            "finder.onnx": to_onnx(finder, (_RGB,), _MAPS),
            "features.onnx": to_onnx(features, (_GREY,), _FEATURES),
        }
        differences = _compare(finder, features, files, rgb, settings["size_px"])
        for name, data in files.items():
            (partial / name).write_bytes(data)
        manifest = json.dumps(asdict(_manifest(loaded, settings, files)), indent=2)
        (partial / MANIFEST).write_text(manifest + "\n", encoding="utf-8")
        if out.exists():
            out.rmdir()
        partial.rename(out)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return differences


def require_empty(out: Path) -> None:
    """Raise InputError if something is where a folder is to be written."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"export {out}: exists and is not an empty folder; choose another one")


def to_onnx(network: nn.Module, inputs: tuple[TensorInfo, ...], outputs: tuple[TensorInfo, ...]) -> bytes:
    """A network of one picture as an ONNX file, for every size in steps of 32 pixels.

    Args:
        network: in evaluation mode; it gives a tuple.
        inputs: what it takes: a picture.
        outputs: what it gives.

    Raises:
        MissingExtraError: the extra ``export`` is not installed.
    """
    _, onnx = require("onnxscript"), require("onnx")
    height, width = (torch.export.Dim(side, min=1, max=_MOST_STEPS) for side in "HW")
    channels = inputs[0].shape[1]
    with _quietly(), torch.no_grad():
        program = torch.onnx.export(
            network,
            (torch.zeros(1, channels, 3 * SIDE_PX, 5 * SIDE_PX),),
            input_names=[info.name for info in inputs],
            output_names=[info.name for info in outputs],
            opset_version=OPSET,
            dynamo=True,
            dynamic_shapes=({2: SIDE_PX * height, 3: SIDE_PX * width},),
            custom_translation_table=_translations(),
            verbose=False,
        )
    assert program is not None
    model = program.model_proto
    for made in (model, model.graph, *model.graph.node):  # where in this installation's files it came from
        del made.metadata_props[:]
    del model.graph.value_info[:]
    for value, info in zip([*model.graph.input, *model.graph.output], [*inputs, *outputs], strict=True):
        del value.metadata_props[:]
        for dim, size in zip(value.type.tensor_type.shape.dim, info.shape, strict=True):
            if isinstance(size, str):
                dim.dim_param = size
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString()


def session(model: bytes) -> Callable[[Tensor], tuple[Tensor, ...]]:
    """A function that runs a graph of one input.

    Raises:
        MissingExtraError: the extra ``export`` is not installed.
    """
    running = require("onnxruntime").InferenceSession(model, providers=["CPUExecutionProvider"])
    name = running.get_inputs()[0].name

    def run(picture: Tensor) -> tuple[Tensor, ...]:
        return tuple(torch.from_numpy(output) for output in running.run(None, {name: picture.numpy()}))

    return run


class _Maps(nn.Module):
    """The finder with its maps as a tuple."""

    def __init__(self, network: FinderNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, rgb: Float[Tensor, "1 3 H W"]) -> tuple[Tensor, ...]:
        maps = self.network(rgb)
        return tuple(getattr(maps, f.name) for f in fields(FinderMaps))


@contextmanager
def _quietly() -> Iterator[None]:
    """Without what the exporter says of modules that it does not need."""
    log = logging.getLogger("torch.onnx")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.setLevel(level)


def _translations() -> dict[Any, Any]:
    """Normalisations with means of rows, then of their means.

    ONNX Runtime sums a whole picture for its own InstanceNormalization, and is wrong in the fourth digit.
    """
    op = require("onnxscript").opset18

    def standard(x: Any, eps: float) -> Any:
        def mean(of: Any) -> Any:
            return op.ReduceMean(op.ReduceMean(of, op.Constant(value_ints=[3])), op.Constant(value_ints=[2]))

        centred = op.Sub(x, mean(x))
        return op.Div(centred, op.Sqrt(op.Add(mean(op.Mul(centred, centred)), op.Constant(value_float=eps))))

    def instance_norm(x: Any, *_: Any, eps: float = 1e-5, **__: Any) -> Any:
        return standard(x, eps)

    def group_norm(x: Any, groups: int, weight: Any, bias: Any, eps: float = 1e-5, _: bool = True) -> Any:
        rows = op.Reshape(x, op.Constant(value_ints=[0, groups, -1, 0]))
        standardised = op.Reshape(standard(rows, eps), op.Shape(x))
        last = op.Constant(value_ints=[1, 2])
        return op.Add(op.Mul(standardised, op.Unsqueeze(weight, last)), op.Unsqueeze(bias, last))

    return {torch.ops.aten.instance_norm.default: instance_norm, torch.ops.aten.group_norm.default: group_norm}


def _compare(
    finder: _Maps,
    features: XFeat,
    files: Mapping[str, bytes],
    rgb: UInt8[np.ndarray, "H W 3"],
    size_px: int,
) -> list[Difference]:
    """Differences between PyTorch and ONNX Runtime at two sizes.

    Raises:
        WeightsError: one is above :data:`TOLERANCE`.
    """
    found = []
    for network, picture, name, outputs in (
        (finder, lambda seen: seen, "finder", _MAPS),
        (features, lambda seen: seen.mean(dim=1, keepdim=True), "features", _FEATURES),
    ):
        run = session(files[f"{name}.onnx"])
        for image, longer_px in ((rgb, size_px), (np.rot90(rgb), size_px * 3 // 5)):
            seen = picture(torch.from_numpy(placed(image, longer_px)[0]).permute(2, 0, 1)[None] / 255)
            with torch.inference_mode():
                expected = network(seen)
            for info, ours, theirs in zip(outputs, expected, run(seen), strict=True):
                sides = (ours[:, :2] + ours[:, 2:]).repeat(1, 2, 1, 1) if info.content == _EXTENT else 1
                difference = (ours - theirs).abs() / sides
                size = (seen.shape[-1], seen.shape[-2])
                found.append(Difference(name, info.name, size, float(difference.max())))
    if wrong := [difference for difference in found if not difference.largest <= TOLERANCE]:
        worst = max(wrong, key=lambda difference: difference.largest)
        raise WeightsError(
            f"export: {worst.output} of {worst.network}.onnx differs from PyTorch by {worst.largest:.1e} at "
            f"{worst.size[0]} x {worst.size[1]}, expected at most {TOLERANCE:.0e}; nothing was written: these versions "
            "of torch, onnxscript and onnxruntime do not fit these weights"
        )
    return found


def _manifest(loaded: LoadedNetwork, settings: dict[str, Any], files: Mapping[str, bytes]) -> Manifest:
    def hashed(name: str) -> str:
        return hashlib.sha256(files[name]).hexdigest()

    finder = Graph(
        "finder.onnx",
        hashed("finder.onnx"),
        loaded.name,
        loaded.sha256,
        loaded.licence,
        f"resized so that the longer side has {settings['size_px']} pixels, by the mean of areas where it shrinks, "
        f"else bilinearly; put into the upper left corner of a picture of grey value {GREY} whose sides are the next "
        f"multiples of {SIDE_PX}; divided by 255",
        (_RGB,),
        _MAPS,
    )
    features = Graph(
        "features.onnx",
        hashed("features.onnx"),
        PACKAGED.stem,
        hashlib.sha256(PACKAGED.read_bytes()).hexdigest(),
        "Apache-2.0",
        "luminance 0.299 R + 0.587 G + 0.114 B, rounded; divided by 255; resized bilinearly, without smoothing, so "
        f"that both sides are the next smaller multiples of {SIDE_PX}, at least {SIDE_PX}",
        (_GREY,),
        _FEATURES,
    )
    return Manifest(FORMAT, version(DISTRIBUTION), OPSET, settings, finder, features)
