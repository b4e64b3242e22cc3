"""``quest train``: teach a network with takes, into a file that ``quest track`` loads."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeVar

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

from quest.train.settings import TrainingConfig, WindowConfig

if TYPE_CHECKING:
    import torch

    from quest.model.config import DecoderConfig
    from quest.model.network import WindowNetwork
    from quest.train.dataset import Dataset
    from quest.train.loop import StepReport
    from quest.train.stage import Objective

C = TypeVar("C", bound="DecoderConfig")


@dataclass(frozen=True)
class NetworkChanges:
    """What is to be different from the preset, as in an ablation; what is left out stays as it is."""

    window: int | None = None
    """T, frames that the decoder sees together."""
    slots: int | None = None
    """K, most entities that discovery returns, and number of learned queries."""
    decoder_layers: int | None = None
    """Layers of the decoder."""
    points3d: bool | None = None
    """Whether depth is seen: position codes of lifted 3D points, and details of depth."""
    intents: bool | None = None
    """Whether entities to open are told from entities to lift."""

    def apply(self, preset: C) -> C:
        """The preset with the changes.

        Raises:
            ConfigError: the preset has no such setting.
        """
        from quest.errors import ConfigError

        changes = {name: value for name, value in asdict(self).items() if value is not None}
        for name in changes:
            if not hasattr(preset, name):
                raise ConfigError(f"--network.{name}: the network of this preset has no such setting; omit it")
        return replace(preset, **changes)


@dataclass(frozen=True)
class Train:
    """Train a network on takes; run again with the same --out to go on.

    On several GPUs of a machine: --training.devices N (or auto). On several machines: torchrun --no-python quest train.
    """

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
    stage: Literal[1, "map", 2] = 1
    """1 trains everything that follows entities; map trains the affordance map of --weights, from which entities are
    discovered, and nothing else; 2 trains the flow head of --weights and nothing else."""
    mirrored: tuple[str, ...] = ()
    """Stores whose training takes teach by their mirror images; name a store in --data too to use both."""
    preset: Literal["default", "paper"] = "default"
    """Network to train, unless --weights is given."""
    network: NetworkChanges = field(default_factory=NetworkChanges)
    """What is different from the preset."""
    cache: Path | None = None
    """Folder of the feature cache; default: OUT/cache."""
    training: TrainingConfig = field(default_factory=TrainingConfig)
    """How to train."""
    windows: WindowConfig = field(default_factory=WindowConfig)
    """How windows are drawn."""
    losses: dict[str, float] = field(default_factory=dict)
    """Losses of stage 1 that are to count more or less than in the preset, such as vel 0 acc 1; 0 turns one off."""

    def run(self) -> int:
        """Prepare, train, write the file."""
        import torch

        from quest.train.devices import launch
        from quest.train.loop import fit

        fabric = launch(self.training)
        first = fabric.is_global_zero
        console = Console(stderr=True, highlight=False, quiet=not first)
        torch.manual_seed(self.training.seed)
        start = self._start()
        self.out.mkdir(parents=True, exist_ok=True)
        with Progress(*_columns(), console=console, disable=not first) as progress:
            # The first process prepares features; then the others find them.
            with fabric.rank_zero_first():
                dataset = self._dataset(start.network, fabric.device, progress)
            best = fit(
                self._objective(start.network),
                dataset.training,
                dataset.validation,
                self.training,
                out=self.out,
                report=_training_bar(progress, self.training.steps),
                fabric=fabric,
            )
        if first:
            file = self._write(best, start, dataset)
            console.print(f"weights: {escape(str(file))}")
        return 0

    def _start(self) -> _Start:
        """What to train, and what to store with it."""
        from quest.errors import ConfigError
        from quest.model.config import DEFAULT
        from quest.model.network import QuestNetwork
        from quest.paper.network import PaperConfig, PaperNetwork
        from quest.track.settings import TrackerConfig
        from quest.train.dataset import load_initial_encoder

        if self.stage != 1 and self.losses:
            raise ConfigError(f"train: stage {self.stage} has a loss of its own; omit --losses")
        if self.weights is not None:
            if self.encoder is not None:
                raise ConfigError("train: trained weights have an encoder of their own; omit --encoder")
            if self.network != NetworkChanges():
                raise ConfigError("train: trained weights have a network of their own; omit --network.*")
            return self._start_from(self.weights)
        if self.stage != 1:
            raise ConfigError(f"train: stage {self.stage} needs --weights, a network that stage 1 has trained")
        if self.encoder is None:
            raise ConfigError(
                "train: pass --encoder FILE to start anew, or --weights NAME to start from trained weights"
            )
        if self.preset == "paper":
            network = PaperNetwork(self.network.apply(PaperConfig()))
        else:
            network = QuestNetwork(self.network.apply(DEFAULT))
        load_initial_encoder(network, self.encoder)
        return _Start(network, TrackerConfig().to_json())

    def _start_from(self, weights: str) -> _Start:
        """Trained weights, with the head that the stage trains."""
        from quest.errors import ConfigError
        from quest.model.weights import find_weights, load_network
        from quest.paper.network import is_paper, read_paper
        from quest.train.flow import with_flow_head, without_flow_head
        from quest.train.mapping import with_own_map

        path = find_weights(weights)
        if is_paper(path):
            if self.stage == "map":
                raise ConfigError(f"train: {weights} is the published network, which has no affordance map to train")
            paper = read_paper(path)
            network = (with_flow_head if self.stage == 2 else without_flow_head)(paper.network.train())
            return _Start(network, about=f"{paper.about}; ", licence=paper.licence)
        loaded = load_network(weights)
        network, before = loaded.network.train(), f"{loaded.about}; "
        if self.stage == 1:
            return _Start(without_flow_head(network), loaded.settings, about=before, licence=loaded.licence)
        grown = with_flow_head(network) if self.stage == 2 else with_own_map(network)
        return _Start(grown, loaded.settings, before, loaded.licence)

    def _dataset(self, network: WindowNetwork[DecoderConfig], device: torch.device, progress: Progress) -> Dataset:
        from quest.cli.takes import open_store, say_corrupt
        from quest.train.dataset import open_dataset

        say_corrupt(open_store(store) for store in dict.fromkeys((*self.data, *self.validation, *self.mirrored)))
        return open_dataset(
            network,
            stores=self.data,
            validation_stores=self.validation,
            mirrored_stores=self.mirrored,
            cache=self.cache or self.out / "cache",
            windows=self.windows,
            device=device,
            report=_feature_bar(progress),
            anchors_only=self.stage == "map",
        )

    def _objective(self, network: WindowNetwork[DecoderConfig]) -> Objective:
        from quest.model.network import QuestNetwork
        from quest.paper.network import PaperNetwork
        from quest.paper.objective import PaperStageOne
        from quest.train.flow import StageTwo
        from quest.train.mapping import StageMap
        from quest.train.stage import StageOne

        if self.stage == "map":
            assert isinstance(network, QuestNetwork)
            return StageMap(network)
        if isinstance(network, PaperNetwork):
            first = PaperStageOne(network, self.losses)
        else:
            assert isinstance(network, QuestNetwork)
            first = StageOne(network, self.losses)
        return first if self.stage == 1 else StageTwo(network, first.answered)

    def _write(self, best: Path, start: _Start, dataset: Dataset) -> Path:
        """The best checkpoint as a file that the tracker loads."""
        from quest.model.network import QuestNetwork
        from quest.model.weights import save_network
        from quest.paper.network import PaperNetwork
        from quest.train.checkpoint import load_checkpoint
        from quest.train.dataset import licence_after

        network = start.network.cpu()
        load_checkpoint(best, network, None)
        file = self.out / "weights.safetensors"
        how = f"--preset {self.preset}" if self.weights is None else f"--stage {self.stage}"
        about = f"{start.about}quest train {how}, {dataset.training_takes} training takes"
        licence = licence_after(start.licence, dataset.training_sources)
        if isinstance(network, PaperNetwork):
            network.save(file, about=about, licence=licence)
        else:
            assert isinstance(network, QuestNetwork)
            save_network(file, network, settings=start.settings, about=about, licence=licence)
        return file


@dataclass(frozen=True)
class _Start:
    """What to train; settings of the tracker to store with it, as JSON text; licence."""

    network: WindowNetwork[DecoderConfig]
    settings: str = ""
    about: str = ""
    licence: str = ""


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
            progress.console.print(f"step {report.step}: {report.scores}")

    return stepped
