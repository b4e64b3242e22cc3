"""The networks of a folder that ``quest export`` wrote, under ONNX Runtime on the processor."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

from torch import Tensor

from quest.errors import WeightsError
from quest.extras import require
from quest.model.finder import FinderMaps, FinderNetwork
from quest.model.onnx_export import FORMAT, MANIFEST, Graph, Manifest, session
from quest.model.weights import LoadedNetwork
from quest.model.xfeat import PACKAGED, XFeat
from quest.untrusted import build, is_name, read_json, reading, require_file

_REMEDY = "make the folder again with `quest export`"


def read_exported(folder: Path, loaded: LoadedNetwork) -> tuple[FinderNetwork, XFeat]:
    """The finder and the features; ONNX Runtime computes what their ``forward`` gives.

    Args:
        folder: with the manifest.
        loaded: weights that were exported; what else is asked of the finder is answered by its network.

    Raises:
        WeightsError: the folder is not there, torn, of another version, or of other weights.
        MissingExtraError: the extra ``export`` is not installed.
    """
    require("onnxruntime")
    manifest = _read_manifest(folder)
    finder = _run(folder, manifest.finder, loaded.sha256, f"the weights {loaded.name}")
    features = _run(folder, manifest.features, file_sha256(PACKAGED), "this version's features")
    network, dense = loaded.network, XFeat.from_package()
    network.forward = lambda rgb: FinderMaps(*finder(rgb))  # type: ignore[method-assign]
    dense.forward = features  # type: ignore[method-assign]
    return network, dense


def file_sha256(path: Path) -> str:
    """Of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _read_manifest(folder: Path) -> Manifest:
    path = folder / MANIFEST
    remedy = "expected a folder of `quest export`, or torch, bfloat16 or onnx"
    require_file(path, WeightsError, remedy)
    values = read_json(path, WeightsError, remedy)
    with reading(path, WeightsError, _REMEDY):
        if values["format"] != FORMAT:
            raise ValueError(f"expected format {FORMAT}, got {values['format']}")
        return build(Manifest, values, "manifest")


def _run(folder: Path, graph: Graph, weights_sha256: str, weights: str) -> Callable[[Tensor], tuple[Tensor, ...]]:
    """A function that runs a graph of the folder, if it is of these weights and whole."""
    if graph.weights_sha256 != weights_sha256:
        raise WeightsError(
            f"{folder}: expected networks of {weights} ({weights_sha256[:8]}), got those of {graph.weights} "
            f"({graph.weights_sha256[:8]}); name the weights that were exported, or export these"
        )
    path = folder / graph.file
    if not is_name(graph.file):
        raise WeightsError(f"{folder / MANIFEST}: {graph.file!r} is no name of a file; {_REMEDY}")
    require_file(path, WeightsError, _REMEDY)
    data = path.read_bytes()
    if hashlib.sha256(data).hexdigest() != graph.sha256:
        raise WeightsError(f"{path}: it was changed since it was exported; {_REMEDY}")
    with reading(path, WeightsError, _REMEDY):
        return session(data)
