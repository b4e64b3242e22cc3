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

TableName = Literal["parts", "window", "slots", "losses", "design", "data"]
PresetName = Literal["default", "paper"]
TABLES: tuple[TableName, ...] = ("parts", "window", "slots", "losses", "design", "data")

LOSSES_3D = ("point", "vel", "acc", "geo", "joint")
"""Losses that know of 3D; the others are of pixels, features and confidences."""

LOSSES_OF: dict[PresetName, tuple[str, ...]] = {
    "default": tuple(name for name in LOSSES if name != "bound"),  # a heatmap's coordinates cannot leave the image
    "paper": tuple(PAPER_LOSSES),
}
"""Losses that are not zero by construction."""


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
        sources: of the takes that teach it; None for all.
    """

    name: str
    network: DecoderConfig
    losses: dict[str, float] = field(default_factory=dict)
    windows: WindowConfig = field(default_factory=WindowConfig)
    flow: bool = False
    no_depth: bool = False
    sources: tuple[str, ...] | None = None


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


def changed(preset: PresetName, name: str, **fields: object) -> Variant:
    """A preset with other fields of the network."""
    network = replace(_NETWORKS[preset], **fields)  # type: ignore[arg-type]
    return full(preset) if network == _NETWORKS[preset] else Variant(f"{preset}-{name}", network)


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
    """The rows of a table; every variant of a preset is compared with that preset as it is."""
    makers = {
        "parts": _parts,
        "window": _window,
        "slots": _slots,
        "losses": _losses,
        "design": _design,
        "data": _data,
    }
    rows = makers[table]
    return tuple(line for preset in presets for line in rows(preset))


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
        ]
    # The paper's network never sees depth and is not grounded: shown depth or not, only the lifting would differ.
    blind = "quest-pixels" if preset == "default" else "quest"
    lines.append(Line(f"{preset}: no 3D", no_3d(preset), blind, own))
    lines.append(Line(f"{preset}: no smoothness", without(preset, "smoothness", "vel", "acc"), "quest", own))
    if preset == "default":
        lines += [
            Line(f"{preset}: no grounding", whole, "quest-ungrounded", own),
            *(
                Line(f"{preset}: flow chain{f', noise {noise}' if noise else ''}", whole, name, own)
                for name, entry in TRACKERS.items()
                if (noise := entry.settings.get("noise")) is not None
            ),
        ]
    return [*lines, Line(f"{preset}: hold still", whole, "hold-still", own)]


def _window(preset: PresetName) -> list[Line]:
    own = f"{preset}: T = {_NETWORKS[preset].window}"
    labels = {t: f"{preset}: T = {t}" for t in (2, 4, 8)}
    return [
        Line(label, changed(preset, f"window-{t}", window=t), reference=None if label == own else own)
        for t, label in labels.items()
    ]


def _slots(preset: PresetName) -> list[Line]:
    """Learned queries are as many as there are slots; anchored ones are as many as are asked for."""
    if preset != "paper":
        return []
    own = f"{preset}: K = {_NETWORKS[preset].slots}"
    labels = {k: f"{preset}: K = {k}" for k in (4, 8, 16)}
    return [
        Line(label, changed(preset, f"slots-{k}", slots=k), reference=None if label == own else own)
        for k, label in labels.items()
    ]


def _losses(preset: PresetName) -> list[Line]:
    own = f"{preset}: all losses"
    lines = [Line(own, full(preset))]
    return lines + [
        Line(f"{preset}: no {loss}", without(preset, loss, loss), "quest", own) for loss in LOSSES_OF[preset]
    ]


def _design(preset: PresetName) -> list[Line]:
    if preset != "default":
        return []
    own = f"{preset}: as it is"
    codes = changed(preset, "no-points3d", points3d=False)
    return [Line(own, full(preset)), Line(f"{preset}: no 3D position codes", codes, "quest", own)]


def _data(preset: PresetName) -> list[Line]:
    """Objects free for any use against all; the steps are the same."""
    if preset != "default":
        return []
    own = f"{preset}: all training objects"
    free = replace(full(preset), name=f"{preset}-procedural", flow=False, sources=("procedural",))
    return [Line(own, full(preset)), Line(f"{preset}: procedural objects only", free, "quest", own)]
