"""``quest train``: teach a network with takes, into a file that ``quest track`` loads."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from quest.train.settings import LossWeights, TrainingConfig, WindowConfig

if TYPE_CHECKING:
    from quest.model.network import QuestNetwork
    from quest.train.loop import StepReport


@dataclass(frozen=True)
class Train:
    """Train a network on takes; run again with the same --out to go on."""

    data: tuple[str, ...]
    """Folders of take stores; the committed object split says which takes teach and which choose."""
    out: Path
    """Folder of the run: checkpoints, curves, and the file weights.safetensors."""
    encoder: Path | None = None
    """Initial encoder weights (quest weights import-encoder); needed unless --weights is given."""
    weights: str | None = None
    """Start from these trained weights (a name or a file) instead, to fit your own objects."""
    validation: tuple[str, ...] = ()
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

        from quest.model.weights import save_network
        from quest.track.tracker import pick_device
        from quest.train.checkpoint import load_checkpoint
        from quest.train.dataset import open_dataset
        from quest.train.loop import fit

        console = Console(stderr=True, highlight=False)
        torch.manual_seed(self.training.seed)
        network, settings = self._start()
        self.out.mkdir(parents=True, exist_ok=True)
        with Progress(*_columns(), console=console) as progress:
            dataset = open_dataset(
                network,
                stores=self.data,
                validation_stores=self.validation,
                cache=self.cache or self.out / "cache",
                windows=self.windows,
                device=pick_device("auto"),
                report=_feature_bar(progress),
            )
            best = fit(
                network,
                dataset.training,
                dataset.validation,
                self.training,
                self.losses,
                out=self.out,
                report=_training_bar(progress, self.training.steps),
            )
        network.cpu()
        load_checkpoint(best, network, None)
        file = self.out / "weights.safetensors"
        about = f"quest train --preset {network.config.preset}, {dataset.training_takes} training takes"
        save_network(file, network, settings=settings, about=about)
        console.print(f"weights: {escape(str(file))}")
        return 0

    def _start(self) -> tuple[QuestNetwork, str]:
        """The network to train, and the tracker's settings to store with it, as JSON text."""
        from quest.errors import ConfigError
        from quest.model.config import PRESETS
        from quest.model.network import QuestNetwork
        from quest.model.weights import load_network
        from quest.track.settings import TrackerConfig
        from quest.train.dataset import load_initial_encoder

        if self.weights is not None:
            loaded = load_network(self.weights)
            return loaded.network.train(), loaded.settings
        if self.encoder is None:
            raise ConfigError(
                "train: pass --encoder FILE to start anew, or --weights NAME to start from trained weights"
            )
        network = QuestNetwork(PRESETS[self.preset])
        load_initial_encoder(network, self.encoder)
        return network, TrackerConfig().to_json()


def _columns() -> tuple[ProgressColumn, ...]:
    return (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )


def _feature_bar(progress: Progress) -> Callable[[int, int, int], None]:
    bar = progress.add_task("features", total=None)

    def prepared(done: int, total: int, frames: int) -> None:
        progress.update(bar, completed=done, total=total, description=f"features of {frames} frames")

    return prepared


def _training_bar(progress: Progress, steps: int) -> Callable[[StepReport], None]:
    bar = progress.add_task("training", total=steps)

    def stepped(report: StepReport) -> None:
        progress.update(bar, completed=report.step, description=f"loss {report.loss:.3f}, best {report.best:.4f}")
        if report.scores is not None:
            s = report.scores
            progress.console.print(
                f"step {report.step}: median {s.median_px:.2f} px, 3D distance {s.mean_distance:.4f}, "
                f"right {s.right:.1%}, discovery F1 {s.discovery_f1:.3f} (n = {s.answers})"
            )

    return stepped
