"""``quest train``: teach a network with takes, into a file that ``quest track`` loads."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from quest.train.settings import LossWeights, TrainingConfig, WindowConfig


@dataclass(frozen=True)
class Train:
    """Train a network on takes; run again with the same --out to go on."""

    data: tuple[Path, ...]
    """Folders of take stores; the committed object split says which takes teach and which choose."""
    out: Path
    """Folder of the run: checkpoints, curves, and the file weights.safetensors."""
    encoder: Path | None = None
    """Initial encoder weights (quest weights import-encoder); needed unless --weights is given."""
    weights: str | None = None
    """Start from these trained weights (a name or a file) instead, to fit your own objects."""
    validation: tuple[Path, ...] = ()
    """Stores to choose by, for objects that are in no split."""
    preset: Literal["default", "paper"] = "default"
    """Network to train, unless --weights is given."""
    cache: Path | None = None
    """Folder of the feature cache; default: OUT/cache."""
    training: TrainingConfig = field(default_factory=TrainingConfig)
    """How to train."""
    windows: WindowConfig = field(default_factory=WindowConfig)
    """How windows are drawn."""
    losses: LossWeights = field(default_factory=LossWeights)
    """Weight of every loss."""

    def run(self) -> int:
        """Prepare, train, write the file."""
        import torch

        from quest.errors import ConfigError
        from quest.model.config import PRESETS
        from quest.model.network import QuestNetwork
        from quest.model.weights import load_network, save_network
        from quest.track.settings import TrackerConfig
        from quest.track.tracker import pick_device
        from quest.train.checkpoint import load_checkpoint
        from quest.train.dataset import load_initial_encoder, open_dataset
        from quest.train.loop import StepReport, fit

        console = Console(stderr=True, highlight=False)
        settings = TrackerConfig().to_json()
        torch.manual_seed(self.training.seed)
        if self.weights is not None:
            loaded = load_network(self.weights)
            network, settings = loaded.network.train(), loaded.settings
        elif self.encoder is not None:
            network = QuestNetwork(PRESETS[self.preset])
            load_initial_encoder(network, self.encoder)
        else:
            raise ConfigError("train: pass --encoder FILE to start anew, or --weights NAME to go on from trained weights")
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
        self.out.mkdir(parents=True, exist_ok=True)
        with Progress(*columns, console=console) as progress:
            bar = progress.add_task("features", total=None)

            def prepared(done: int, total: int, frames: int) -> None:
                progress.update(bar, completed=done, total=total, description=f"features of {frames} frames")

            dataset = open_dataset(
                network,
                stores=self.data,
                validation_stores=self.validation,
                cache=self.cache or self.out / "cache",
                windows=self.windows,
                device=pick_device("auto"),
                report=prepared,
            )
            bar = progress.add_task("training", total=self.training.steps)

            def stepped(report: StepReport) -> None:
                progress.update(bar, completed=report.step, description=f"loss {report.loss:.3f}, best {report.best:.4f}")
                if report.scores is not None:
                    s = report.scores
                    console.print(
                        f"step {report.step}: median {s.median_px:.2f} px, 3D distance {s.mean_distance:.4f}, "
                        f"right {s.right:.1%}, discovery F1 {s.discovery_f1:.3f} (n = {s.answers})"
                    )

            best = fit(
                network, dataset.training, dataset.validation, self.training, self.losses, out=self.out, report=stepped
            )
        network.cpu()
        load_checkpoint(best, network, None)
        file = self.out / "weights.safetensors"
        about = f"quest train --preset {network.config.preset}, {dataset.training_takes} training takes"
        save_network(file, network, settings=settings, about=about)
        console.print(f"weights: {escape(str(file))}")
        return 0
