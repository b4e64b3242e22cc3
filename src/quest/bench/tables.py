"""The tables of the publication: what each is made of, and how its rows are shown."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from quest.bench.intents import IntentAnswer, intent_rows, judge_intents
from quest.bench.occlusion import STILL, reappearances
from quest.bench.rows import Answers, rows_of
from quest.bench.settings import SetName
from quest.bench.speed import speed_rows
from quest.bench.variants import BASES, REMEDIES, Variant, trained_losses, without_3d
from quest.bench.workbench import Asked, TakesName, Workbench, build
from quest.bench.writing import Figure, Table
from quest.data.split import part_of
from quest.errors import ConfigError
from quest.evaluation.bootstrap import Pool
from quest.evaluation.metrics import Sums, distance_at
from quest.evaluation.records import EntityRecord
from quest.evaluation.summary import object_of, readings_of

Rows = list[dict[str, Any]]
Report = Mapping[str, Rows]
"""Rows by the key that they have in the file."""
Make = Callable[[Workbench], Report]


@dataclass(frozen=True)
class Recipe:
    """How a table is made."""

    about: str
    """What it says, in one line."""
    make: Make
    """Makes its rows, and all that they rest on."""
    pages: tuple[Table, ...]
    figure: Figure | None = None


TABLES: dict[str, Recipe] = {}
"""Every table by its name on the command line."""


def _shown(*pages: Table, figure: Figure | None = None) -> Callable[[Make], Make]:
    """What the function below makes is a table of its name, shown on these pages; its docstring says what it is of."""

    def add(make: Make) -> Make:
        TABLES[make.__name__] = Recipe(str(make.__doc__), make, pages, figure)
        return make

    return add


def _page(name: str, title: str, columns: str, *, about: str = "", rows: str = "rows", **only: Any) -> Table:
    return Table(f"bench/{name}.json", title, columns, rows=rows, only=only, about=about)


SETS: Mapping[str, SetName] = {"new motions": "motions", "new views": "views", "new objects": "objects"}
"""What a network that learned from some objects is judged by; only the first is what the publication seems to do."""
SHARES = tuple(round(0.1 * i, 1) for i in range(11))
"""Of a take, where the drift curve is read."""

_WHO = "takes = takes_of | objects = source | level = level | of = reading | "
_COUNTS = "objects/takes/tracks = objects/takes/tracks | "
_APE = "APE = metrics.ape | published = published.ape | "
_APE_2D = "APE_2d = metrics.ape_2d | published = published.ape_2d | "
_MORE = (
    "D@50 = metrics.d50 | D@100 = metrics.d100 | published D@100 = published.d100 | "
    "Acc % = %metrics.acc | published Acc % = %published.acc | switches = metrics.switches"
)
_LEVELS = Figure("level", "joints that move", (("metrics.ape", "APE"), ("metrics.acc", "Acc")))


def _network(name: str, title: str, ape: str = _APE) -> Table:
    """A page of networks, and how each differs from one of them."""
    difference = " | Δ APE = difference.ape | Δ Acc % = %difference.acc"
    return _page(name, title, f"{_WHO}line = line | {_COUNTS}{ape}{_MORE}{difference}", reading="moved")


_PUBLISHED_LEVELS: Mapping[str, tuple[Sequence[float], Sequence[float]]] = {
    "full": ((0.065, 0.070, 0.075, 0.081), (0.920, 0.902, 0.883, 0.865)),
    "no queries": ((0.088, 0.104, 0.119, 0.135), (0.754, 0.709, 0.664, 0.619)),
    "no 3D": ((0.081, 0.093, 0.106, 0.118), (0.718, 0.682, 0.646, 0.611)),
    "no smoothness": ((0.077, 0.094, 0.110, 0.127), (0.736, 0.685, 0.633, 0.581)),
    "flow + 0.01": ((0.113, 0.085, 0.103, 0.107), (0.496, 0.483, 0.388, 0.581)),
    "flow + 0.02": ((0.158, 0.132, 0.197, 0.225), (0.249, 0.253, 0.157, 0.144)),
    "flow + 0.05": ((0.289, 0.312, 0.354, 0.385), (0.093, 0.059, 0.045, 0.032)),
}
_PUBLISHED_D100 = (0.125, 0.135, 0.145, 0.155)
_PUBLISHED_SIZES = {
    "T = 2": (0.142, 0.285, 0.68),
    "T = 4": (0.098, 0.178, 0.78),
    "T = 8": (0.072, 0.125, 0.86),
    "K = 4": (0.095, 0.168, 0.79),
    "K = 8": (0.072, 0.125, 0.86),
    "K = 16": (0.068, 0.118, 0.87),
}
_PUBLISHED_RIVALS = {
    "raft-3d-official": (0.341, 0.472, 0.087),
    "cotracker3-official": (0.276, 0.398, 0.192),
    "tapir-official": (0.251, 0.372, 0.214),
}


def _published(line: str, level: int) -> dict[str, float] | None:
    """What the publication says of a line, as far as it says it; its objects and renderer were others."""
    if line in _PUBLISHED_SIZES:
        return dict(zip(("ape_2d", "d100", "acc"), _PUBLISHED_SIZES[line], strict=True))
    if line in _PUBLISHED_RIVALS and level == 4:
        return dict(zip(("ape", "d100", "acc"), _PUBLISHED_RIVALS[line], strict=True))
    name = "full" if line == "published network" else line
    if name not in _PUBLISHED_LEVELS or not 1 <= level <= 4:
        return None
    ape, acc = _PUBLISHED_LEVELS[name]
    said = {"ape": ape[level - 1], "acc": acc[level - 1]}
    return said | ({"d100": _PUBLISHED_D100[level - 1]} if name == "full" else {})


def _rows(
    bench: Workbench, asked: Sequence[Asked], sets: Mapping[str, TakesName], *, levels: Sequence[int] = ()
) -> Rows:
    """Rows of all lines in all sets, with what was published of new motions.

    Raises:
        ConfigError: no line has a name that was asked for.
    """
    if wanted := bench.making.lines:
        if unknown := sorted({*wanted} - {a.label for a in asked}):
            raise ConfigError(f"--lines {unknown[0]}: expected some of {', '.join(a.label for a in asked)}")
        compared = {a.reference for a in asked if a.label in wanted}
        asked = [a for a in asked if a.label in (*wanted, *compared)]
    found: Rows = []
    for called, takes in sets.items():
        rows = rows_of(bench.answers(asked, takes, levels), resamples=bench.making.resamples, seed=0)
        for row in rows:
            said = _published(row["line"], row["level"]) if takes == "motions" else None
            found.append({"takes_of": called} | row | {"published": said})
    return found


def _compared(bench: Workbench, *, noise: float = 0.0) -> list[Asked]:
    """Our tracker, what it is compared with, and the published network."""
    making = bench.making
    first, *others = making.trackers
    named = [Asked(first, tracker=first, noise=noise)]
    named += [Asked(name, tracker=name, noise=noise, reference=first) for name in others]
    return [*named, Asked("published network", variant=BASES[making.base], noise=noise, reference=first)]


@_shown(
    _page(
        "comparison",
        "Comparison",
        f"{_WHO}tracker = line | {_COUNTS}{_APE}{_MORE}",
        about="The published network and rivals named -retrained learned from other motions of the objects of "
        "the first two sets; the others learned from no object how to follow points, but for the noises of our "
        "filter. Published figures are of other objects.",
        reading="moved",
    ),
    figure=_LEVELS,
)
def comparison(bench: Workbench) -> Report:
    """Every tracker at every level."""
    sets: dict[str, TakesName] = {called: takes for called, takes in SETS.items() if takes in bench.making.sets}
    return {"rows": _rows(bench, _compared(bench), sets)}


@_shown(_network("levels", "Levels and parts"), figure=_LEVELS)
def levels(bench: Workbench) -> Report:
    """The published network without its queries, 3D or smoothness, and chained flow with noise."""
    base = BASES[bench.making.base]
    lines = [
        Asked("full", variant=base),
        Asked("no queries", variant=base, persistent=False, reference="full"),
        Asked("no 3D", variant=without_3d(base), reference="full"),
        Asked("no smoothness", variant=base.without("smoothness", "vel", "acc"), reference="full"),
        *(Asked(f"flow + {n:g}", flow_noise=n, reference="full") for n in (0.01, 0.02, 0.05)),
        Asked("hold still", tracker="hold-still", reference="full"),
    ]
    return {"rows": _rows(bench, lines, {"new motions": "motions"})}


def _variants(bench: Workbench, lines: Mapping[str, Variant], reference: str) -> Report:
    """Networks trained alike but for one thing, at the highest level."""
    asked = [Asked(n, variant=v, reference=None if n == reference else reference) for n, v in lines.items()]
    return {"rows": _rows(bench, asked, {"new motions": "motions"}, levels=[max(bench.making.levels)])}


@_shown(_network("window", "Windows of T frames", _APE_2D))
def window(bench: Workbench) -> Report:
    """Windows of 2, 4 and 8 frames."""
    return _variants(bench, {f"T = {n}": BASES[bench.making.base].sized("window", n) for n in (2, 4, 8)}, "T = 4")


@_shown(_network("slots", "K learned queries", _APE_2D))
def slots(bench: Workbench) -> Report:
    """4, 8 and 16 learned queries."""
    return _variants(bench, {f"K = {n}": BASES[bench.making.base].sized("slots", n) for n in (4, 8, 16)}, "K = 8")


@_shown(_network("losses", "Each loss left out"))
def losses(bench: Workbench) -> Report:
    """Each loss left out."""
    base = BASES[bench.making.base]
    lines = {"all losses": base} | {f"no {loss}": base.without(loss, loss) for loss in trained_losses(base)}
    return _variants(bench, lines, "all losses")


@_shown(_network("remedies", "What helps the published network to learn"))
def remedies(bench: Workbench) -> Report:
    """What helps the published network to learn."""
    return _variants(bench, REMEDIES, "as published")


@_shown(
    _page(
        "noise",
        "Noise of the colours",
        f"objects = source | level = level | of = reading | noise % = %noise | tracker = line | {_COUNTS}"
        "APE = metrics.ape | Acc % = %metrics.acc",
        about="Published, at 5 % noise: more than 96 % for the network, less than 40 % for its rivals.",
        reading="moved",
    ),
    figure=Figure("noise", "noise", (("metrics.ape", "APE"), ("metrics.acc", "Acc"))),
)
def noise(bench: Workbench) -> Report:
    """Every tracker on noisy colours."""
    found: Rows = []
    for share in bench.making.noise:
        asked, highest = _compared(bench, noise=share), [max(bench.making.levels)]
        rows = _rows(bench, asked, {"new motions": "motions"}, levels=highest)
        found += [row | {"noise": share, "published": None} for row in rows]
    return {"rows": found}


@_shown(
    _page(
        "drift",
        "Drift",
        "objects = source | level = level | of = reading | tracker = line | share of the take % = %share | "
        "objects/tracks = objects/tracks | D = metrics.distance",
        share=1.0,
        reading="moved",
    ),
    figure=Figure("share", "share of the take", (("metrics.distance", "D"),), ("source",)),
)
def drift(bench: Workbench) -> Report:
    """Distance over the course of a take."""
    answers = bench.answers(_compared(bench), "motions", [max(bench.making.levels)])
    return {"rows": drift_rows(answers, resamples=bench.making.resamples)}


def drift_rows(answers: Sequence[Answers], *, resamples: int) -> Rows:
    """D@p of every line for p in :data:`SHARES`, per source and reading."""
    groups: dict[tuple[str, str, int], dict[str, list[EntityRecord]]] = defaultdict(lambda: defaultdict(list))
    for one in answers:
        for record in one.records:
            for reading in readings_of(record):
                groups[record.subject.source, reading, record.subject.level][one.line].append(record)
    rows: Rows = []
    for (source, reading, level), lines in sorted(groups.items()):
        for line, records in lines.items():
            pool = Pool(records, object_of, resamples=resamples, seed=0)
            about = {"line": line, "source": source, "reading": reading, "level": level}
            counts = {"objects": pool.objects, "tracks": len({(r.take, r.view, r.entity) for r in records})}
            for share in SHARES:
                value = pool.ratio(_at(records, share))
                if value is not None:
                    rows.append(about | {"share": share} | counts | {"metrics": {"distance": value}})
    return rows


def _at(records: Sequence[EntityRecord], share: float) -> Sums:
    """Sums of D@p, of takes of any length."""
    each = [distance_at(r.distance[None].astype(float), share, r.counted[None]) for r in records]
    return Sums(np.concatenate([s.total for s in each]), np.concatenate([s.count for s in each]))


@_shown(
    _page(
        "failures",
        "Occluded for 60 frames",
        "objects = source | beside = beside | tracker = tracker | occlusions/judged = episodes/judged | "
        "right before % = %held_before | APE while occluded = ape_hidden | right 5 frames after % = "
        "%held_again | of those right before % = %held_again_if_before",
        rows="occlusion",
        about="The joint moves on while the entity is occluded, and stops.",
    ),
    _page(
        "failures",
        "Sixteen identical doors",
        "of = reading | tracker = line | objects/tracks = objects/tracks | switches per 1,000 frames = "
        "metrics.switches | Acc % = %metrics.acc",
        rows="lockers",
    ),
)
def failures(bench: Workbench) -> Report:
    """Entities that are occluded for 60 frames, and banks of like doors."""
    # Without the tracker that holds still nobody knows how far an entity moved.
    asked = [Asked(name, tracker=name) for name in dict.fromkeys((*bench.making.trackers, STILL))]
    hidden = [r for one in bench.answers(asked, "hidden", [1]) for r in one.records]
    lockers = bench.answers(asked, "lockers", [4])
    return {
        "occlusion": reappearances(hidden, resamples=bench.making.resamples, seed=0),
        "lockers": rows_of(lockers, resamples=bench.making.resamples, seed=0),
    }


@_shown(
    _page(
        "intents",
        "Open and lift: both rims of a closed laptop",
        "objects = source | objects/takes/views = objects/takes/views | both stable % = %both | both on their "
        "link % = %kept | APE open = open_ape | APE lift = lift_ape",
    )
)
def intents(bench: Workbench) -> Report:
    """What opens a laptop and what lifts it."""
    store, asked = bench.takes("laptops"), Asked("quest", tracker="quest")
    kept, tracker = bench.kept(asked, "laptops", 0), cache(lambda: build(bench.making, asked, 0))

    def judged(name: str, part: str) -> Mapping[str, np.ndarray]:
        bench.console.print(f"intents {name}", highlight=False)
        take = store.read(name)
        views = range(len(take.views))
        found = [vars(a) for v in views for a in judge_intents(tracker(), take, v, part=part)]
        return {"answers": np.array(json.dumps(found))}

    answers: list[IntentAnswer] = []
    for name, info in sorted(store.infos().items()):
        known = kept.get(name, lambda name=name, info=info: judged(name, part_of(info)))
        answers += [IntentAnswer(**a) for a in json.loads(str(known["answers"]))]
    return {"rows": intent_rows(answers, resamples=bench.making.resamples, seed=0), "answers": list(map(vars, answers))}


@_shown(
    _page(
        "speed",
        "Speed and memory of every tracker",
        "tracker = line | queries = queries | frames = frames | ms a frame = ms | frames/s = frames_per_s | "
        "memory, MiB = memory_mib",
        about="Eight queries, the same clip, one thread, float32; memory is the peak of a process.",
    )
)
def speed(bench: Workbench) -> Report:
    """Time and memory of every tracker."""
    return {"rows": speed_rows(bench.making, _compared(bench))}
