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
    """What is trained."""

    name: str
    """Of its folder."""
    network: PaperConfig = field(default_factory=PaperConfig)
    """What it is."""
    losses: dict[str, float] = field(default_factory=dict)
    """Weights of losses that differ from the published ones."""
    windows: WindowConfig = field(default_factory=WindowConfig)
    """How windows are drawn."""
    order: Order = "match"
    """How entities get their slots."""


@dataclass(frozen=True)
class Line:
    """One row of a table."""

    label: str
    """What the table calls it."""
    variant: Variant
    """Whose weights."""
    tracker: str = "quest"
    """Which tracker answers: ``quest`` with these weights, or one that needs none."""
    reference: str | None = None
    """Label of the row that it is compared with; None for the reference."""


FULL = Variant("full")
"""The published network."""
RIVALS = {"hold still": "hold-still"}
"""Trackers of rows that are not of the network."""


def without(name: str, *losses: str) -> Variant:
    """The published network trained without some losses."""
    return Variant(f"no-{name}", losses=dict.fromkeys(losses, 0.0))


def lines_of(table: TableName) -> tuple[Line, ...]:
    """The rows of a table; the reference of the others is the published network, under the label of its row."""
    from_map = PaperConfig(place_from="map")
    every = {"early": 1.0, "conf": 0.0, "exists": 0.3, "where": 0.3}
    published = [name for name, loss in LOSSES.items() if loss.weight > 0]
    # Without 3D: pixel losses alone, and windows without depth. The tracker lifts by depth as ever.
    flat = replace(without("3d", *LOSSES_3D), windows=WindowConfig(depth_drop_share=1.0))
    rows: dict[TableName, dict[str, Variant]] = {
        "parts": {
            "full": FULL, "no 3D": flat, "no smoothness": without("smoothness", "vel", "acc"), "hold still": FULL
        },
        "window": _sizes("window", "T", (2, 4, 8)),
        "slots": _sizes("slots", "K", (4, 8, 16)),
        "losses": {"all losses": FULL} | {f"no {loss}": without(loss, loss) for loss in published},
        # What is said to help the prediction of sets, one by one and together.
        "remedies": {
            "as published": FULL,
            "loss at every layer": Variant("early", losses={"early": 1.0}),
            "confidence: it exists": Variant("exists", losses={"conf": 0.0, "exists": 0.3}),
            "entity i has slot i": Variant("order", order="entity"),
            "place off the map": Variant("map", from_map, losses={"where": 0.3}),
            "all four": Variant("remedies", from_map, every, order="entity"),
        },
    }  # fmt: skip
    own = next(label for label, variant in rows[table].items() if variant == FULL)
    return tuple(
        Line(
            label, variant, label.replace(" ", "-") if label == "hold still" else "quest", None if label == own else own
        )
        for label, variant in rows[table].items()
    )


def _sizes(name: str, symbol: str, sizes: Sequence[int]) -> dict[str, Variant]:
    """The published network with another number of frames or queries."""
    networks = {size: replace(FULL.network, **{name: size}) for size in sizes}  # type: ignore[arg-type]
    return {
        f"{symbol} = {size}": FULL if network == FULL.network else Variant(f"{name}-{size}", network)
        for size, network in networks.items()
    }


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
