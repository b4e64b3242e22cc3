"""How tables are made; free of heavy imports, so that the command line is quick."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from quest.baselines import TRACKERS
from quest.errors import ConfigError

SetName = Literal["motions", "views", "objects"]
"""What networks are judged by: new motions of the objects that taught, new views of them, or new objects."""
Base = Literal["remedies", "published"]
"""What is varied: the network with all remedies of how sets are learned, or exactly as published."""

TAUGHT = (
    "partnet:26608,41085,45261,46108,7179,100154",
    "procedural:chest-0,cabinet-0,lockers-0,desk-0,wall_unit-0,base_cabinet-0,bare_chest-0",
)
"""Objects that teach the published network: training objects of four joints or more."""
NEW = (
    "partnet:100676,101808,102044,23724",
    "procedural:chest-110001,cabinet-110001,lockers-110001,desk-110001,wall_unit-110001,base_cabinet-110001",
)
"""Test objects of four joints or more."""


@dataclass(frozen=True)
class Making:
    """How everything is made."""

    work: Path = Path("runs/bench")
    """Where takes, runs and answers lie, and are found again."""
    objects_root: Path | None = None
    """Folder of PartNet-Mobility folders; default: the environment variable QUEST_OBJECTS."""
    taught: tuple[str, ...] = TAUGHT
    """Objects that teach the published network and are judged in new motions and views, as of quest generate."""
    new: tuple[str, ...] = NEW
    """Objects that never taught."""
    takes_per_object: int = 4
    """Takes of every object and level that teach."""
    sets: tuple[SetName, ...] = ("motions", "views", "objects")
    """Takes that the comparison judges by; other tables are of new motions."""
    views: int = 1
    """Of the three cameras, how many are judged by."""
    levels: tuple[int, ...] = (1, 2, 3, 4)
    """How many joints move one after the other in takes that judge."""
    teach_levels: tuple[int, ...] = (1, 2, 3, 4)
    """The same in takes that teach."""
    weights: str = "quest-s16"
    """Of our tracker and of plain trackers that need some."""
    rivals: Path | None = None
    """Folder of code and weights of the rivals named -official."""
    trackers: tuple[str, ...] = (
        *("quest", "hold-still", "lk-grid", "lk-reinit", "dis", "xfeat", "dino"),
        *("raft-3d-retrained", "tapnet-retrained", "cotracker-retrained"),
    )
    """Beside the published network."""
    lines: tuple[str, ...] = ()
    """Rows to make, by their names, and those that they are compared with; all by default."""
    base: Base = "remedies"
    """The published network with the remedies of how sets are learned, or exactly as published."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of every training."""
    steps: int = 2500
    """Of every training of the published network."""
    rival_steps: int = 5000
    """Of every training of a rival named -retrained."""
    batch: int = 8
    """Windows of a step of the published network."""
    learning_rate: float = 5e-4
    """Peak of the schedule, of AdamW."""
    noise: tuple[float, ...] = (0.0, 0.01, 0.02, 0.05, 0.1)
    """Of colours, as a share of their range."""
    resamples: int = 1000
    """Of the bootstrap over objects."""
    ray: str | None = None
    """Share the work on a Ray cluster: its address, auto, or local for one on this machine."""

    def __post_init__(self) -> None:
        counts = (self.takes_per_object, self.views, self.steps, self.rival_steps, self.batch, self.resamples)
        if min(*counts, *self.levels, *self.teach_levels) < 1:
            raise ConfigError(f"bench: expected counts, levels, steps and resamples of 1 or more, got {self}")
        lists = (self.seeds, self.levels, self.teach_levels, self.taught)
        if not all(lists) or min(self.seeds) < 0 or min(self.noise, default=0) < 0:
            raise ConfigError(f"bench: expected seeds and noise of 0 or more, levels and objects, got {self}")
        if unknown := [name for name in self.trackers if name not in TRACKERS]:
            raise ConfigError(f"tracker {unknown[0]!r}: expected one of {', '.join(TRACKERS)}")

    def described(self) -> dict[str, Any]:
        """What rows depend on, without places of this machine."""
        places = ("work", "objects_root", "rivals", "ray")
        return {key: value for key, value in asdict(self).items() if key not in places}
