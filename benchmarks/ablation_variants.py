"""The variants of the ablation tables (see ablations.py, and docs/metrics.md for what every row is)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

from quest.baselines import TRACKERS
from quest.errors import ConfigError
from quest.model.config import DEFAULT, DecoderConfig, NetworkConfig
from quest.paper.network import PaperConfig
from quest.paper.objective import LOSSES as PAPER_LOSSES
from quest.train.objective import LOSSES
from quest.train.settings import WindowConfig

TableName = Literal["parts", "window", "slots", "losses"]
PresetName = Literal["default", "paper"]
TABLES: tuple[TableName, ...] = ("parts", "window", "slots", "losses")

LOSSES_3D = ("point", "vel", "acc", "geo", "joint")
"""Losses that know of 3D; the others are of pixels, features and confidences."""

LOSSES_OF: dict[PresetName, tuple[str, ...]] = {"default": tuple(LOSSES), "paper": tuple(PAPER_LOSSES)}


@dataclass(frozen=True)
class Variant:
    """What is trained.

    Attributes:
        name: of its folder.
        network: what it is.
        losses: weights of losses that differ from the preset's.
        windows: how windows are drawn.
        flow: whether stage 2 trains a flow head.
        no_depth: whether it never sees depth.
    """

    name: str
    network: DecoderConfig
    losses: dict[str, float] = field(default_factory=dict)
    windows: WindowConfig = field(default_factory=WindowConfig)
    flow: bool = False
    no_depth: bool = False


@dataclass(frozen=True)
class Line:
    """One row of a table.

    Attributes:
        label: what the table calls it.
        variant: whose weights.
        tracker: which tracker uses them (:data:`quest.baselines.TRACKERS`).
        reference: label of the row that it is compared with; None for the reference.
    """

    label: str
    variant: Variant
    tracker: str = "quest"
    reference: str | None = None


_NETWORKS: dict[PresetName, DecoderConfig] = {"default": replace(DEFAULT, map_layers=0), "paper": PaperConfig()}
"""The presets, but for the default's map: it is read off what queries look at, so that stage 1 trains all of it."""


def full(preset: PresetName) -> Variant:
    """A preset; the default one has a flow head, which changes nothing else."""
    return Variant(preset, _NETWORKS[preset], flow=preset == "default")


def changed(name: str, **fields: int) -> Variant:
    """The published network with other fields."""
    network = replace(_NETWORKS["paper"], **fields)  # type: ignore[arg-type]
    return full("paper") if network == _NETWORKS["paper"] else Variant(f"paper-{name}", network)


def without(preset: PresetName, name: str, *losses: str) -> Variant:
    """A preset trained without some losses."""
    off = dict.fromkeys((loss for loss in losses if loss in LOSSES_OF[preset]), 0.0)
    return Variant(f"{preset}-no-{name}", _NETWORKS[preset], losses=off)


def no_3d(preset: PresetName) -> Variant:
    """Pixel losses alone, and no depth in the network: neither as position codes nor as a window's input."""
    flat = without(preset, "3d", *LOSSES_3D)
    network = flat.network
    if isinstance(network, NetworkConfig):  # the paper's never sees depth
        network = replace(network, points3d=False)
    return replace(flat, network=network, windows=WindowConfig(depth_drop_share=1.0), no_depth=True)


def lines_of(table: TableName, presets: Sequence[PresetName]) -> tuple[Line, ...]:
    """The rows of a table; every variant of a preset is compared with that preset as it is.

    Of the default preset's network the tracker takes nothing but what it finds, so that its head has no rows.
    """
    if table == "parts":
        return tuple(line for preset in presets for line in _parts(preset))
    rows = {"window": _sizes("window", "T", (2, 4, 8)), "slots": _sizes("slots", "K", (4, 8, 16)), "losses": _losses()}
    return tuple(rows[table]) if "paper" in presets else ()


def chosen_lines(
    tables: Sequence[TableName], presets: Sequence[PresetName], variants: Sequence[str]
) -> dict[TableName, tuple[Line, ...]]:
    """The rows of tables: all, or those of some variants and those that these are compared with.

    Raises:
        ConfigError: no row is of such a variant.
    """
    lines: dict[TableName, tuple[Line, ...]] = {table: lines_of(table, presets) for table in tables}
    known = {line.variant.name for each in lines.values() for line in each}
    if unknown := sorted(set(variants) - known):
        raise ConfigError(f"--variants {unknown[0]}: expected some of {', '.join(sorted(known))}")
    if not variants:
        return {table: each for table, each in lines.items() if each}
    asked = {table: [line for line in each if line.variant.name in variants] for table, each in lines.items()}
    compared = {line.reference for each in asked.values() for line in each}
    return {
        table: tuple(line for line in each if line in asked[table] or line.label in compared)
        for table, each in lines.items()
        if asked[table]
    }


def _parts(preset: PresetName) -> list[Line]:
    whole, own = full(preset), f"{preset}: full"
    lines = [Line(own, whole)]
    if preset == "default":
        lines += [
            Line(f"{preset}: no queries", whole, "redetect", own),
            Line(f"{preset}: no queries, detected in every frame", whole, "redetect-1", own),
            Line(f"{preset}: no 3D", no_3d(preset), "quest-pixels", own),
            *(
                Line(f"{preset}: flow chain{f', noise {noise}' if noise else ''}", whole, name, own)
                for name, entry in TRACKERS.items()
                if (noise := entry.settings.get("noise")) is not None
            ),
        ]
    else:
        # The published network never sees depth: shown depth or not, only the lifting would differ.
        lines += [
            Line(f"{preset}: no 3D", no_3d(preset), "quest", own),
            Line(f"{preset}: no smoothness", without(preset, "smoothness", "vel", "acc"), "quest", own),
        ]
    return [*lines, Line(f"{preset}: hold still", whole, "hold-still", own)]


def _sizes(field_name: str, symbol: str, sizes: Sequence[int]) -> list[Line]:
    """The published network with another number of frames or queries."""
    own = f"paper: {symbol} = {getattr(_NETWORKS['paper'], field_name)}"
    labels = {size: f"paper: {symbol} = {size}" for size in sizes}
    return [
        Line(label, changed(f"{field_name}-{size}", **{field_name: size}), reference=None if label == own else own)
        for size, label in labels.items()
    ]


def _losses() -> list[Line]:
    own = "paper: all losses"
    lines = [Line(own, full("paper"))]
    return lines + [Line(f"paper: no {loss}", without("paper", loss, loss), "quest", own) for loss in PAPER_LOSSES]
