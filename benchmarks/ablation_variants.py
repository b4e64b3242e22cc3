"""The variants of the ablation tables (see ablations.py, and docs/metrics.md for what every row is)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

from quest.errors import ConfigError
from quest.paper.network import PaperConfig
from quest.paper.objective import LOSSES, Order
from quest.train.settings import WindowConfig

TableName = Literal["parts", "window", "slots", "losses", "remedies"]
TABLES: tuple[TableName, ...] = ("parts", "window", "slots", "losses", "remedies")

LOSSES_3D = ("vel", "acc", "geo")
"""Losses that know of 3D; the others are of pixels, features, labels and confidences."""


@dataclass(frozen=True)
class Variant:
    """What is trained.

    Attributes:
        name: of its folder.
        network: what it is.
        losses: weights of losses that differ from the published ones.
        windows: how windows are drawn.
        order: how entities get their slots.
    """

    name: str
    network: PaperConfig = field(default_factory=PaperConfig)
    losses: dict[str, float] = field(default_factory=dict)
    windows: WindowConfig = field(default_factory=WindowConfig)
    order: Order = "match"


@dataclass(frozen=True)
class Line:
    """One row of a table.

    Attributes:
        label: what the table calls it.
        variant: whose weights.
        tracker: which tracker answers: ``quest`` with these weights, or one that needs none.
        reference: label of the row that it is compared with; None for the reference.
    """

    label: str
    variant: Variant
    tracker: str = "quest"
    reference: str | None = None


FULL = Variant("full")
"""The published network."""


def without(name: str, *losses: str) -> Variant:
    """The published network trained without some losses."""
    return Variant(f"no-{name}", losses=dict.fromkeys(losses, 0.0))


def no_3d() -> Variant:
    """Pixel losses alone, and windows without depth. The network never sees it; the tracker lifts by it as ever."""
    return replace(without("3d", *LOSSES_3D), windows=WindowConfig(depth_drop_share=1.0))


def lines_of(table: TableName) -> tuple[Line, ...]:
    """The rows of a table; the first is what the others are compared with, or has its size among theirs."""
    rows = {
        "parts": _parts(),
        "window": _sizes("window", "T", (2, 4, 8)),
        "slots": _sizes("slots", "K", (4, 8, 16)),
        "losses": _losses(),
        "remedies": _remedies(),
    }
    return tuple(rows[table])


def chosen_lines(tables: Sequence[TableName], variants: Sequence[str]) -> dict[TableName, tuple[Line, ...]]:
    """The rows of tables: all, or those of some variants and those that these are compared with.

    Raises:
        ConfigError: no row is of such a variant.
    """
    lines: dict[TableName, tuple[Line, ...]] = {table: lines_of(table) for table in tables}
    known = {line.variant.name for each in lines.values() for line in each}
    if unknown := sorted(set(variants) - known):
        raise ConfigError(f"--variants {unknown[0]}: expected some of {', '.join(sorted(known))}")
    if not variants:
        return lines
    asked = {table: [line for line in each if line.variant.name in variants] for table, each in lines.items()}
    compared = {line.reference for each in asked.values() for line in each}
    return {
        table: tuple(line for line in each if line in asked[table] or line.label in compared)
        for table, each in lines.items()
        if asked[table]
    }


def _parts() -> list[Line]:
    return [
        Line("full", FULL),
        Line("no 3D", no_3d(), reference="full"),
        Line("no smoothness", without("smoothness", "vel", "acc"), reference="full"),
        Line("hold still", FULL, "hold-still", "full"),
    ]


def _sizes(field_name: str, symbol: str, sizes: Sequence[int]) -> list[Line]:
    """The published network with another number of frames or queries."""
    published = getattr(FULL.network, field_name)
    own = f"{symbol} = {published}"
    lines = []
    for size in sizes:
        network = replace(FULL.network, **{field_name: size})  # type: ignore[arg-type]
        variant = FULL if size == published else Variant(f"{field_name}-{size}", network)
        lines.append(Line(f"{symbol} = {size}", variant, reference=None if size == published else own))
    return lines


def _losses() -> list[Line]:
    own = "all losses"
    published = [name for name, loss in LOSSES.items() if loss.weight > 0]
    return [Line(own, FULL), *(Line(f"no {loss}", without(loss, loss), reference=own) for loss in published)]


def _remedies() -> list[Line]:
    """What is said to help the prediction of sets, one by one and together."""
    own, from_map = "as published", PaperConfig(place_from="map")
    variants = {
        "loss at every layer": Variant("early", losses={"early": 1.0}),
        "confidence: it exists": Variant("exists", losses={"conf": 0.0, "exists": 0.3}),
        "entity i has slot i": Variant("order", order="entity"),
        "place off the map": Variant("map", from_map, losses={"where": 0.3}),
        "all four": Variant("remedies", from_map, {"early": 1.0, "conf": 0.0, "exists": 0.3, "where": 0.3},
                            order="entity"),
    }  # fmt: skip
    return [Line(own, FULL), *(Line(label, variant, reference=own) for label, variant in variants.items())]
