"""Rivals as their authors published them: their own code and their own checkpoint, where the user has both.

Nothing of either comes with this package, nothing is fetched, and no pickle is read: checkpoints are safetensors, which
their owner makes of the published files. ``docs/metrics.md`` says how. All lies in one folder, in which the code has
the name that ``git clone`` gives it, and the weights of a tracker the tracker's name.
"""

from __future__ import annotations

import sys
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from torch import nn

from quest.data.provenance import file_hash
from quest.errors import ConfigError, WeightsError
from quest.model.tensor_file import read_tensors
from quest.track.tracker import pick_device

_SAID = 5
"""Names of tensors that an error lists."""


@cache
def import_code(folder: Path, module: str) -> Any:
    """A module of other people's code, from the folder that they run it from.

    Their names, such as ``utils``, hide no module of ours and are hidden by none: after the import they are gone from
    ``sys.modules``. The random numbers go on as if nothing had been imported.

    Raises:
        ConfigError: the code is not there, or needs a package that is not installed.
    """
    if not folder.joinpath(*module.split(".")).with_suffix(".py").is_file():
        raise ConfigError(f"{folder}: expected the module {module} there; clone its repository to this place")
    own = {entry.stem for entry in folder.iterdir()}
    aside = {name: sys.modules.pop(name) for name in list(sys.modules) if name.partition(".")[0] in own}
    sys.path.insert(0, str(folder))
    try:
        with torch.random.fork_rng(devices=[]):
            return import_module(module)
    except ImportError as error:
        raise ConfigError(f"{folder}: {module} cannot be imported ({error}); install what it needs") from error
    finally:
        sys.path.remove(str(folder))
        for name in [name for name in sys.modules if name.partition(".")[0] in own]:
            del sys.modules[name]
        sys.modules.update(aside)


def load_weights(network: nn.Module, path: Path) -> str:
    """Load a converted checkpoint, all of it and nothing else.

    Returns:
        SHA-256 of the file.

    Raises:
        WeightsError: no such file, a torn one, or one of another network.
    """
    if not path.is_file():
        raise WeightsError(f"{path}: no such file; docs/metrics.md says how to make it of the published checkpoint")
    _, tensors = read_tensors(path)
    try:
        wrong = network.load_state_dict(tensors, strict=False)
    except RuntimeError as error:
        raise WeightsError(f"{path}: tensors of other shapes than this official network's ({error})") from error
    parts = {"missing": wrong.missing_keys, "unexpected": wrong.unexpected_keys}
    said = [f"{len(names)} {what} ({', '.join(names[:_SAID])})" for what, names in parts.items() if names]
    if said:
        raise WeightsError(
            f"{path}: not the weights of this official network: {', '.join(said)}; convert the checkpoint that "
            "docs/metrics.md names"
        )
    return str(file_hash(path))


class Official:
    """A network of other people's, ready to answer.

    Raises:
        ConfigError: the code is not there or cannot be imported.
        WeightsError: the checkpoint is not there, is torn, or is of another network.
    """

    def __init__(self, name: str, rivals: Path, network: nn.Module) -> None:
        self.name = name
        self.device = pick_device("auto")
        self.rival_hash = load_weights(network, rivals / f"{name}.safetensors")
        self.network: Any = network.to(self.device).eval().requires_grad_(requires_grad=False)
