"""Tensors to and from safetensors files, with errors for people where that fails."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from quest.errors import WeightsError
from quest.whole_file import whole_file


def part_of(name: str) -> str:
    """The part of a network that a tensor belongs to: the first word of its name."""
    return name.partition(".")[0]


def read_tensors(path: Path, parts: tuple[str, ...] | None = None) -> tuple[dict[str, str], dict[str, Tensor]]:
    """Metadata and tensors of a safetensors file.

    Args:
        path: the file.
        parts: first words of the names of the tensors to read; all by default.

    Raises:
        WeightsError: it is torn, or no such file.
    """
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            names = [name for name in file.keys() if parts is None or part_of(name) in parts]  # noqa: SIM118 (not a dict)
            return metadata, {name: file.get_tensor(name) for name in names}
    except (SafetensorError, OSError) as error:
        raise WeightsError(f"{path}: not a whole safetensors file ({error}); fetch or train it again") from error


def save_tensors(tensors: Mapping[str, Tensor], path: Path, *, metadata: Mapping[str, str] | None = None) -> None:
    """Write a safetensors file, whole or not at all.

    Args:
        tensors: contiguous, by their names.
        path: of the file; its folder is made.
        metadata: words to keep beside them.

    Raises:
        WeightsError: the file cannot be written: no permission, no space left, no such folder.
    """
    try:
        with whole_file(path) as partial:
            save_file(dict(tensors), partial, metadata=None if metadata is None else dict(metadata))
            partial.chmod(0o644)  # safetensors makes files that only their owner can read
    except (SafetensorError, OSError) as error:
        raise WeightsError(f"{path}: cannot be written ({error}); free space there, or name another place") from error
