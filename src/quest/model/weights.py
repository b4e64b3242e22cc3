"""Files of trained networks: one safetensors file with tensors, configuration and settings."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from quest.errors import ConfigError, WeightsError
from quest.model.config import NetworkConfig
from quest.model.encoder import load_exactly
from quest.model.network import QuestNetwork

FORMAT = "quest-network-1"


@dataclass(frozen=True)
class LoadedNetwork:
    """A network read from a file.

    Attributes:
        name: name or path that it was asked for by.
        path: file that it came from.
        network: in evaluation mode, on the CPU.
        settings: settings of the tracker that were chosen with these weights, as JSON text.
        about: where the weights come from.
        sha256: of the file.
        monitor: calibration of the monitor that was fitted with these weights, as JSON text; None without.
    """

    name: str
    path: Path
    network: QuestNetwork
    settings: str
    about: str
    sha256: str
    monitor: str | None = None


def save_network(path: Path, network: QuestNetwork, *, settings: str, about: str, monitor: str | None = None) -> None:
    """Write a network in half precision, atomically.

    Args:
        path: file to write.
        network: the network with its encoder.
        settings: settings of the tracker, as JSON text.
        about: where the weights come from, a line for people.
        monitor: calibration of the monitor, as JSON text; None without.
    """
    tensors = {name: tensor.detach().cpu().half().contiguous() for name, tensor in network.state_dict().items()}
    metadata = {"format": FORMAT, "config": network.config.to_json(), "settings": settings, "about": about}
    metadata |= {} if monitor is None else {"monitor": monitor}
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    save_file(tensors, partial, metadata=metadata)
    partial.chmod(0o644)  # safetensors makes files that only their owner can read
    partial.replace(path)


def shipped_weights() -> dict[str, Path]:
    """Name and file of every network that comes with the package."""
    folder = resources.files("quest") / "assets" / "weights"
    if not folder.is_dir():
        return {}
    found = [Path(str(entry)) for entry in folder.iterdir() if entry.name.endswith(".safetensors")]
    return {path.stem: path for path in sorted(found)}


def load_network(name: str | Path) -> LoadedNetwork:
    """Read a network by the name of shipped weights or by path.

    Raises:
        WeightsError: no such name or file, or the file is torn, foreign, or of another shape.
    """
    path = shipped_weights().get(str(name), Path(name))
    if not path.is_file():
        known = ", ".join(shipped_weights()) or "none"
        raise WeightsError(f"{name}: no such weights; expected a safetensors file or a shipped name ({known})")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            state = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (not a dict)
    except (SafetensorError, OSError) as error:
        raise WeightsError(f"{path}: not a whole safetensors file ({error}); fetch or train it again") from error
    if metadata.get("format") != FORMAT:
        raise WeightsError(
            f"{path}: expected a network of format {FORMAT!r}, got {metadata.get('format')!r}; "
            "write it with `quest train` (encoder weights alone are not a network)"
        )
    try:
        network = QuestNetwork(NetworkConfig.from_json(metadata["config"]))
    except (ConfigError, KeyError) as error:
        raise WeightsError(f"{path}: {error}; the file is of another version of quest") from error
    load_exactly(network, {k: v.to(torch.float32) for k, v in state.items()}, what=f"weights {path}")
    with path.open("rb") as file:
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    return LoadedNetwork(
        name=str(name),
        path=path,
        network=network.eval(),
        settings=metadata.get("settings", "{}"),
        about=metadata.get("about", ""),
        sha256=sha256,
        monitor=metadata.get("monitor"),
    )
