"""Measure the flow head: EPE3D beside zero flow and beside differences of lifted points.

    python benchmarks/scene_flow.py --takes STORE --weights FILE --out benchmarks/results/scene_flow/validation.json

What each of these sees is said in `quest.evaluation.scene_flow`. A stride of 1 asks for the next frame, as a stream
would; a larger one for the frame as far on as the frames of the window are apart, which is what training on thinned
takes looks like. Features are prepared in a cache that can be kept. The result file is written anew after each take,
and says until the last one that it is not complete.
"""

from __future__ import annotations

import tempfile
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import tyro
from rich import box
from rich.console import Console
from rich.table import Table

from quest.data.provenance import combined_hash
from quest.data.store import TakeStore
from quest.errors import WeightsError
from quest.evaluation.report import provenance, shown, write_report
from quest.evaluation.scene_flow import ANSWERS, MOVED, MOVING, FlowRecord, FlowRow, flow_errors, flow_rows, records_of
from quest.evaluation.selection import select_takes
from quest.model.weights import LoadedNetwork, load_network
from quest.track.tracker import pick_device
from quest.train.feature_cache import FeatureCache


@dataclass(frozen=True)
class SceneFlow:
    """EPE3D of weights with a flow head, per source, suite, level and stride."""

    takes: str
    """Folder of the take store; takes with every frame."""
    weights: str
    """Name or file of weights with a flow head (quest train --stage 2)."""
    split: tuple[Literal["train", "validation", "test", "unlisted"], ...] = ("validation",)
    """Parts of the object split."""
    level: tuple[int, ...] = ()
    """Levels; all by default."""
    objects: tuple[str, ...] = ()
    """Object ids; all by default."""
    stride: tuple[int, ...] = (1, 6)
    """Frames between the frames of a window, and to the one that is asked for."""
    cache: Path | None = None
    """Folder of the feature cache; a temporary one by default."""
    resamples: int = 1000
    """Of the bootstrap over objects."""
    seed: int = 0
    """Of the bootstrap."""
    out: Path | None = None
    """Result file."""

    def run(self) -> int:
        """Measure take by take, print, write."""
        loaded, device = load_network(self.weights), pick_device("auto")
        if loaded.network.flow is None:
            raise WeightsError(f"{self.weights}: no flow head in it; train one with `quest train --stage 2`")
        network = loaded.network.to(device)
        store, console = TakeStore(self.takes), Console(width=170, highlight=False)
        chosen = select_takes(store.infos(), split=self.split, levels=self.level, objects=self.objects)
        about = self._about(loaded, combined_hash((name, store.data_hash(name)) for name in chosen))
        records: list[FlowRecord] = []
        rows: tuple[FlowRow, ...] = ()
        with nullcontext(self.cache) if self.cache else tempfile.TemporaryDirectory() as folder:
            features = FeatureCache(Path(folder), network.config, network.encoder)
            for i, (name, part) in enumerate(chosen.items(), start=1):
                list(features.build(store, [name], device=device))
                info = store.infos()[name]
                for view in features.views([name]):
                    for stride in self.stride:
                        flow = flow_errors(network, view, stride=stride, device=device)
                        if flow is not None:
                            records += records_of(
                                flow,
                                take=name,
                                view=view.name,
                                object_id=info.object_id,
                                part=part,
                                source=info.source,
                                suite=info.suite,
                                level=info.level,
                                stride=stride,
                            )
                rows = flow_rows(records, resamples=self.resamples, seed=self.seed)
                console.print(f"{i}/{len(chosen)} {name}: {len(records)} records so far")
                if self.out is not None:
                    done = {"takes_done": i, "complete": i == len(chosen), "rows": [asdict(row) for row in rows]}
                    write_report(about | done, self.out)
        console.print(_table(rows))
        return 0

    def _about(self, loaded: LoadedNetwork, data_hash: str) -> dict[str, Any]:
        return provenance() | {
            "weights": self.weights,
            "weights_hash": loaded.sha256,
            "data_hash": data_hash,
            "moved": MOVED,
            "moving": MOVING,
            "resamples": self.resamples,
            "seed": self.seed,
        }


def _table(rows: tuple[FlowRow, ...]) -> Table:
    table = Table(
        title="EPE3D, normalised units per step",
        box=box.SIMPLE_HEAD,
        caption=f"95 % bootstrap over objects; moved: more than {MOVED} from rest at some time; moving: of these, "
        f"steps longer than {MOVING}",
    )
    for heading in ("objects", "suite", "L", "stride", "reading", "objects/takes/entities", *ANSWERS):
        table.add_column(heading, justify="left" if heading in ("objects", "suite", "reading") else "right")
    for row in rows:
        table.add_row(
            f"{row.source}, {row.part}",
            row.suite,
            str(row.level),
            str(row.stride),
            row.reading,
            f"{row.objects}/{row.takes}/{row.entities}",
            *(shown(row.epe[answer], decimals=4) for answer in ANSWERS),
        )
    return table


if __name__ == "__main__":
    raise SystemExit(tyro.cli(SceneFlow).run())
