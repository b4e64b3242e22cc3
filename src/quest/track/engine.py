"""What runs the tracker's networks: PyTorch in either precision, or ONNX Runtime from a folder of exported networks."""

from __future__ import annotations

import hashlib
import logging
from dataclasses import replace
from pathlib import Path

import torch
from huggingface_hub import cached_assets_path

from quest.data.recording import read_recording
from quest.data.sample import SAMPLES
from quest.model.finder import FinderNetwork
from quest.model.onnx_engine import file_sha256, read_exported
from quest.model.onnx_export import FORMAT, MANIFEST, Difference, export_networks
from quest.model.precision import fast_bfloat16
from quest.model.weights import LoadedNetwork
from quest.model.xfeat import PACKAGED, XFeat
from quest.track.settings import TrackerConfig

_LOG = logging.getLogger(__name__)


BY_TORCH = ("torch", "bfloat16")
"""Engines that run on any device."""


def networks(loaded: LoadedNetwork, engine: str | Path, device: torch.device) -> tuple[FinderNetwork, XFeat]:
    """The finder and the dense features, as an engine runs them.

    Args:
        loaded: the finder's weights.
        engine: ``torch``; ``bfloat16``, which is PyTorch in that precision; ``onnx``, which exports them once into a
            cache; or a folder of ``quest export``.
        device: where they are going to run.

    Raises:
        WeightsError: the folder is torn, of another version, or of other weights.
        MissingExtraError: the extra ``export`` is not installed.
    """
    if engine in BY_TORCH:
        found = loaded.network, XFeat.from_package()
        if engine == "bfloat16":
            if not fast_bfloat16(device):
                _LOG.warning("engine bfloat16: %s only emulates it, which takes longer than float32", device)
            for network in found:
                network.forward = torch.autocast(device.type, torch.bfloat16)(network.forward)  # type: ignore[method-assign]
        return found
    return read_exported(_cached(loaded) if engine == "onnx" else Path(engine), loaded)


def export(loaded: LoadedNetwork, out: Path) -> list[Difference]:
    """:func:`quest.model.onnx_export.export_networks`, compared on the packaged clip; what it raises is raised."""
    settings = TrackerConfig.from_json(loaded.settings).to_json()
    return export_networks(replace(loaded, settings=settings), out, rgb=read_recording(SAMPLES[0]).rgb[0])


def _cached(loaded: LoadedNetwork) -> Path:
    """The folder of networks that were exported earlier, or now."""
    made_of = f"{FORMAT} {loaded.sha256} {file_sha256(PACKAGED)}"
    key = hashlib.sha256(made_of.encode()).hexdigest()
    folder = cached_assets_path(library_name="quest", namespace="onnx", subfolder=key[:16])
    if not (folder / MANIFEST).is_file():
        _LOG.warning("exporting %s to ONNX once, which takes a minute or more; kept in %s", loaded.name, folder)
        try:
            export(loaded, folder)
        except OSError:
            if not (folder / MANIFEST).is_file():  # unless another process was faster
                raise
    return folder
