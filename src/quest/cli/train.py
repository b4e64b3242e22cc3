"""``quest train``: teach a network with pictures and takes, into a file that ``quest track`` loads."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rich.progress import Progress

from quest.cli.console import Console
from quest.cli.progress import bars
from quest.cli.takes import open_store, say_corrupt
from quest.errors import ConfigError
from quest.train.finding.settings import FinderSamplerConfig
from quest.train.settings import TrainingConfig, WindowConfig

if TYPE_CHECKING:
    import torch

    from quest.paper.network import PaperConfig
    from quest.train.batches import Sampler
    from quest.train.loop import Objective, StepReport


@dataclass(frozen=True)
class NetworkChanges:
    """What of the published network is to be different, as in an ablation; what is omitted stays as it is."""

    window: int | None = None
    """T, frames that the decoder sees together."""
    slots: int | None = None
    """K, number of learned queries."""
    decoder_layers: int | None = None
    """Layers of the decoder."""
    place_from: Literal["mlp", "map"] | None = None
    """Whether coordinates come out of the MLP, as published, or off the last attention map."""

    def apply(self, preset: PaperConfig) -> PaperConfig:
        """The preset with the changes."""
        return replace(preset, **{name: value for name, value in asdict(self).items() if value is not None})


@dataclass(frozen=True)
class Train:
    """Train a network; run again with the same --out to go on.

    Stage find teaches the finder of the tracker with labelled pictures, takes, or both. Stages 1 and 2 teach the
    published network (preset paper) with takes: its queries, then its flow head.

    On several GPUs of a machine: --training.devices N (or auto). On several machines: torchrun --no-python quest train.
    """

    out: Path
    """Folder of the run: checkpoints, curves, and the file weights.safetensors."""
    data: tuple[str, ...] = ()
    """Folders of take stores; the committed object split says which takes teach and which choose."""
    pictures: tuple[Path, ...] = ()
    """Stage find: labelled pictures: COCO files, YOLO data sets, folders with pictures/ and labels.csv. A fifth of
    them, by their names, chooses and does not teach."""
    free: bool = False
    """Stage find: only pictures that name a licence teach and choose."""
    stage: Literal["find", 1, 2] = "find"
    """Find: what can be taken hold of. 1: everything of the published network that follows entities. 2: the flow head
    of --weights and nothing else."""
    encoder: Path | None = None
    """Initial weights of the vision transformer (quest weights import-encoder); needed unless --weights is given."""
    detail: Path | None = None
    """Stage find: initial weights of EfficientNet (quest weights import-detail); needed unless --weights is given."""
    weights: str | None = None
    """Start from these trained weights (a name or a file) instead, to fit your own objects."""
    validation: tuple[str, ...] = ()
    """Stores to choose by: for objects that are in no split, or with new motions of those that teach."""
    network: NetworkChanges = field(default_factory=NetworkChanges)
    """What of the published network is different."""
    order: Literal["match", "entity"] = "match"
    """Stage 1: whether slots are matched to entities at the least cost, as published, or entity i always has slot i."""
    cache: Path | None = None
    """Folder of the feature cache; default: OUT/cache."""
    training: TrainingConfig = field(default_factory=TrainingConfig)
    """How to train."""
    windows: WindowConfig = field(default_factory=WindowConfig)
    """How windows of stages 1 and 2 are drawn."""
    finding: FinderSamplerConfig = field(default_factory=FinderSamplerConfig)
    """How cuts of stage find are drawn."""
    views: int = 4
    """Stage find: views that are made of every picture, where the transformer does not learn."""
    frames: int = 2
    """Stage find: frames that are taken of every view of a take."""
    losses: dict[str, float] = field(default_factory=dict)
    """Losses that are to count more or less than in the preset, such as vel 0 acc 1; 0 turns one off."""

    def run(self) -> int:
        """Prepare, train, write the file."""
        import torch

        from quest.train.devices import launch
        from quest.train.loop import fit

        fabric = launch(self.training)
        first = fabric.is_global_zero
        console = Console(stderr=True, highlight=False, quiet=not first)
        torch.manual_seed(self.training.seed)
        start = self._start_finder() if self.stage == "find" else self._start_paper()
        self.out.mkdir(parents=True, exist_ok=True)
        with bars(console, disable=not first) as progress:
            # The first process prepares features; then the others find them.
            with fabric.rank_zero_first():
                taught = self._taught(start, fabric.device, progress)
            best = fit(
                taught.objective,
                taught.training,
                taught.validation,
                self.training,
                out=self.out,
                report=_training_bar(progress, self.training.steps),
                fabric=fabric,
            )
        if first:
            file = self._write(best, start, taught)
            console.print(f"weights: {file}")
        return 0

    def _start_finder(self) -> _Start:
        """The finder to train, and what to store with it."""
        from quest.model.encoder import load_exactly
        from quest.model.finder import FinderConfig, FinderNetwork
        from quest.model.tensor_file import read_tensors
        from quest.model.weights import load_network
        from quest.track.settings import TrackerConfig
        from quest.train.dataset import load_initial_encoder

        if not self.data and not self.pictures:
            raise ConfigError("train: pass --pictures FILE_OR_FOLDER or --data STORE to learn from")
        if self.weights is not None:
            if self.encoder is not None or self.detail is not None:
                raise ConfigError("train: trained weights have an encoder of their own; omit --encoder and --detail")
            loaded = load_network(self.weights)
            return _Start(loaded.network.train(), loaded.settings, f"{loaded.about}; ", loaded.licence)
        if self.encoder is None or self.detail is None:
            raise ConfigError(
                "train: pass --encoder FILE and --detail FILE to start anew, or --weights NAME to start from trained "
                "weights"
            )
        network = FinderNetwork(FinderConfig())
        load_initial_encoder(network, self.encoder)
        load_exactly(network.detail, read_tensors(self.detail)[1], what=f"--detail {self.detail}")
        return _Start(network.train(), TrackerConfig().to_json())

    def _start_paper(self) -> _Start:
        """The published network, with the head that the stage trains."""
        from quest.model.weights import find_weights
        from quest.paper.flow import with_flow_head, without_flow_head
        from quest.paper.network import PaperConfig, PaperNetwork, read_paper
        from quest.train.dataset import load_initial_encoder

        if not self.data:
            raise ConfigError(f"train: stage {self.stage} learns from takes; pass --data STORE")
        if self.stage == 2 and self.losses:
            raise ConfigError("train: stage 2 has a loss of its own; omit --losses")
        if self.weights is not None:
            if self.encoder is not None or self.network != NetworkChanges():
                raise ConfigError(
                    "train: trained weights have their own encoder and network; omit --encoder, --network"
                )
            paper = read_paper(find_weights(self.weights))
            network = (with_flow_head if self.stage == 2 else without_flow_head)(paper.network.train())
            return _Start(network, about=f"{paper.about}; ", licence=paper.licence)
        if self.stage == 2:
            raise ConfigError("train: stage 2 needs --weights, a network that stage 1 has trained")
        if self.encoder is None:
            raise ConfigError(
                "train: pass --encoder FILE to start anew, or --weights NAME to start from trained weights"
            )
        network = PaperNetwork(self.network.apply(PaperConfig()))
        load_initial_encoder(network, self.encoder)
        return _Start(network)

    def _taught(self, start: _Start, device: torch.device, progress: Progress) -> _Taught:
        """What is learned, and from what."""
        say_corrupt(open_store(store) for store in dict.fromkeys((*self.data, *self.validation)))
        bar = progress.add_task("features", total=None)
        cache = self.cache or self.out / "cache"
        if self.stage == "find":
            from quest.train.finding.dataset import open_finder_data
            from quest.train.finding.objective import StageFind

            def viewed(done: int, total: int) -> None:
                progress.update(bar, completed=done, total=total, description="views")

            found = open_finder_data(
                start.network.to(device),
                pictures=self.pictures,
                free=self.free,
                stores=self.data,
                validation_stores=self.validation,
                cache=cache,
                views=self.views,
                frames=self.frames,
                config=self.finding,
                report=viewed,
            )
            objective = StageFind(
                start.network,
                self.losses,
                learned_blocks=self.finding.learned_blocks,
                second_alone=self.finding.second_alone,
            )
            return _Taught(objective, found.training, found.validation, found.about, found.sources)
        from quest.paper.flow import StageTwo
        from quest.paper.objective import PaperStageOne
        from quest.train.dataset import open_dataset

        def prepared(done: int, total: int, frames: int) -> None:
            progress.update(bar, completed=done, total=total, description=f"features of {frames} frames")

        dataset = open_dataset(
            start.network,
            stores=self.data,
            validation_stores=self.validation,
            cache=cache,
            windows=self.windows,
            device=device,
            report=prepared,
        )
        first = PaperStageOne(start.network, self.losses, order=self.order)
        objective = first if self.stage == 1 else StageTwo(start.network, first.answered)
        about = f"{dataset.training_takes} training takes"
        return _Taught(objective, dataset.training, dataset.validation, about, dataset.training_sources)

    def _write(self, best: Path, start: _Start, taught: _Taught) -> Path:
        """The best checkpoint as a file that the tracker loads."""
        from quest.model.weights import save_network
        from quest.train.checkpoint import load_checkpoint
        from quest.train.dataset import licence_after

        network = start.network.cpu()
        load_checkpoint(best, network, None)
        file = self.out / "weights.safetensors"
        about = f"{start.about}quest train --stage {self.stage}, {taught.about}"
        licence = licence_after(start.licence, taught.sources)
        if self.stage == "find":
            save_network(file, network, settings=start.settings, about=about, licence=licence)
        else:
            network.save(file, about=about, licence=licence)
        return file


@dataclass(frozen=True)
class _Start:
    """The network to train; settings of the tracker to store with it, as JSON text; licence."""

    network: Any
    settings: str = ""
    about: str = ""
    licence: str = ""


@dataclass(frozen=True)
class _Taught:
    """What is learned and from what, in words too."""

    objective: Objective
    training: Sampler
    validation: Sampler
    about: str
    sources: frozenset[str]


def _training_bar(progress: Progress, steps: int) -> Callable[[StepReport], None]:
    bar = progress.add_task("training", total=steps)

    def stepped(report: StepReport) -> None:
        progress.update(bar, completed=report.step, description=f"loss {report.loss:.3f}, best {report.best:.4f}")
        if report.scores is not None:
            progress.console.print(f"step {report.step}: {report.scores}")

    return stepped
