"""State as bytes: a tree of dataclasses, containers, arrays and numbers becomes a safetensors file and a tree again."""

from __future__ import annotations

import hashlib
import json
from collections import deque
from dataclasses import fields, is_dataclass
from enum import Enum
from types import GenericAlias, NoneType
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
import torch
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor

from quest.errors import InputError
from quest.untrusted import reading

FORMAT = "quest-stream-22"
_KEY = "quest-stream"
_T = TypeVar("_T")


def save(tree: object) -> bytes:
    """A tree as a safetensors file; the same tree gives the same bytes.

    Args:
        tree: dataclasses, lists, tuples, deques, dicts, arrays, tensors, enums, numbers, texts and None, nested freely.
    """
    tensors: dict[str, Tensor] = {}
    header = {"format": FORMAT, "tree": _flatten(tree, "tree", tensors)}
    header["sha256"] = _digest(header["tree"], tensors)
    # One entry: the order of several is not fixed.
    return save_tensors(tensors, metadata={_KEY: json.dumps(header, sort_keys=True)})


def load(data: bytes, kind: type[_T] | GenericAlias, *, device: torch.device | str = "cpu") -> _T:
    """The tree that :func:`save` was given.

    Args:
        data: what it gave.
        kind: type of the tree; the annotations of dataclasses tell the types of what they hold.
        device: where tensors go. Those in double precision stay on the CPU, because not every device has it.

    Raises:
        InputError: the bytes are corrupt, of another format, or hold another kind of tree.
    """
    with reading(f"saved stream of {len(data)} bytes", InputError, "give the bytes of Tracker.save()"):
        tensors = load_tensors(data)
        length = int.from_bytes(data[:8], "little")
        header = json.loads(json.loads(data[8 : 8 + length])["__metadata__"][_KEY])
        if header["format"] != FORMAT:
            raise InputError(f"saved stream: expected format {FORMAT!r}, got {header['format']!r}")
        if header.keys() != {"format", "tree", "sha256"} or header["sha256"] != _digest(header["tree"], tensors):
            raise InputError("saved stream: the bytes were changed, their checksum is another; save it again")
        return _unflatten(kind, header["tree"], tensors, torch.device(device))


def _digest(tree: Any, tensors: dict[str, Tensor]) -> str:
    """SHA-256 of all that is kept, in hexadecimal."""
    digest = hashlib.sha256(json.dumps(tree, sort_keys=True).encode())
    for name, tensor in sorted(tensors.items()):
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        plain = tensor.view(torch.int16) if tensor.dtype == torch.bfloat16 else tensor  # which NumPy lacks
        digest.update(plain.contiguous().numpy().tobytes())
    return digest.hexdigest()


def _flatten(value: Any, path: str, tensors: dict[str, Tensor]) -> Any:
    """A value as JSON; arrays and tensors are put aside under their path."""
    if isinstance(value, np.ndarray):
        tensors[path] = torch.from_numpy(np.array(value, order="C"))
        return {"array": path}
    if isinstance(value, Tensor):
        tensors[path] = value.detach().cpu().clone(memory_format=torch.contiguous_format)
        return {"tensor": path}
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, np.generic):
        return value.item()
    if is_dataclass(value):
        return {f.name: _flatten(getattr(value, f.name), f"{path}.{f.name}", tensors) for f in fields(value)}
    if isinstance(value, dict):
        return [[key, _flatten(item, f"{path}.{key}", tensors)] for key, item in value.items()]
    if isinstance(value, deque):
        return {"maxlen": value.maxlen, "items": _flatten(list(value), path, tensors)}
    if isinstance(value, list | tuple):
        return [_flatten(item, f"{path}.{i}", tensors) for i, item in enumerate(value)]
    return value


def _unflatten(kind: Any, node: Any, tensors: dict[str, Tensor], device: torch.device) -> Any:
    """What :func:`_flatten` was given, by its type."""

    def item(kind: Any, node: Any) -> Any:
        return _unflatten(kind, node, tensors, device)

    origin, args = get_origin(kind), get_args(kind)
    if node is None:
        return None
    if isinstance(node, dict) and len(node) == 1 and "array" in node:
        return tensors[node["array"]].numpy()
    if isinstance(node, dict) and len(node) == 1 and "tensor" in node:
        tensor = tensors[node["tensor"]]
        return tensor if tensor.dtype == torch.float64 else tensor.to(device)
    if NoneType in args:
        return item(next(arg for arg in args if arg is not NoneType), node)
    if is_dataclass(kind):
        return _made(kind, {name: item(of, node[name]) for name, of in get_type_hints(kind).items() if name in node})
    if origin is dict:
        return {key: item(args[1], value) for key, value in node}
    if origin is deque:
        return deque((item(args[0], value) for value in node["items"]), node["maxlen"])
    if origin is list:
        return [item(args[0], value) for value in node]
    if origin is tuple:
        kinds = args[:1] * len(node) if args[1:] == (...,) else args
        return tuple(item(of, value) for of, value in zip(kinds, node, strict=True))
    return kind(node) if isinstance(kind, type) and issubclass(kind, Enum) else node


def _made(kind: Any, values: dict[str, Any]) -> Any:
    """A dataclass of such fields, defaults where an older version had none; those not of its constructor come last."""
    made = kind(**{f.name: values[f.name] for f in fields(kind) if f.init and f.name in values})
    for f in fields(kind):
        if not f.init and f.name in values:
            setattr(made, f.name, values[f.name])
    return made
