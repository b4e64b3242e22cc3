"""``quest data stats``: the content of a store, in numbers."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from quest.cli.progress import counting
from quest.wording import counted

if TYPE_CHECKING:
    from quest.data.stats import Spread, StoreStats


@dataclass(frozen=True)
class DataStats:
    """Count the takes of a store, the share that is visible, the motion, and the missing depth."""

    store: Annotated[str, tyro.conf.Positional]
    """Folder or URL of takes."""

    json: Path | None = None
    """Also write the numbers to this file."""

    def run(self) -> int:
        """Print a table; returns 0."""
        from rich.console import Console
        from rich.table import Table

        from quest.cli.takes import open_store, wide_console
        from quest.data.stats import store_stats
        from quest.evaluation.report import write_report

        store = open_store(self.store)
        with counting(Console(stderr=True), "reading", None, "takes") as report:
            found = store_stats(store, report=report)
        if self.json is not None:
            write_report(finite(asdict(found)), self.json)
        table = Table(box=None, show_header=False)
        table.add_column(no_wrap=True, style="dim")
        table.add_column(overflow="fold")
        for name, value in _rows(found):
            table.add_row(name, value)
        wide_console().print(table)
        return 0


def _rows(found: StoreStats) -> Iterator[tuple[str, str]]:
    unreadable = f"; {found.unreadable} cannot be read" if found.unreadable else ""
    yield "takes", f"{found.takes} of {counted(found.objects, 'object')}{unreadable}"
    yield (
        "frames",
        f"{found.frames} in {counted(found.views, 'view')}, {found.hours:.2f} hours, pixels: {_counts(found.image_px)}",
    )
    yield "on disk", f"{found.stored_bytes / 1e9:.3f} GB"
    for name in ("sources", "categories", "levels", "suites"):
        yield name, _counts(getattr(found, name))
    yield "entities", _counts(found.labels)
    yield "moving cameras", f"{found.moving_cameras} of {found.views} views"
    yield (
        "depth",
        (
            f"{found.with_depth_sensor} of {found.takes} takes through a sensor model; missing in "
            f"{_percent(found.depth_missing_share)} of all pixels and "
            f"{_percent(found.depth_missing_share_on_object)} of the objects'"
        ),
    )
    labels = ", ".join(f"{label} {_percent(share)}" for label, share in found.visible_share_by_label.items())
    yield (
        "visible",
        f"{_percent(found.visible_share)} of frames, entities and views" + (f" ({labels})" if labels else ""),
    )
    yield "never seen", f"{_percent(found.never_seen)} of entities and views"
    yield "moved", f"{_percent(found.moved_share)} of entities, by more than 0.1 normalised units"
    yield "motion", f"{_spread(found.motion)} normalised units; {_spread(found.motion_m)} m"
    yield "object diagonal", f"{_spread(found.diagonal_m)} m"
    yield "camera to entity", f"{_spread(found.distance_m)} m"
    yield "", "ranges: median (10 % to 90 %; least to most)"


def _counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{name} ({count})" for name, count in counts.items()) or "none"


def _percent(share: float) -> str:
    return "?" if math.isnan(share) else f"{100 * share:.1f} %"


def _spread(s: Spread) -> str:
    return f"{s.median:.2f} ({s.low:.2f} to {s.high:.2f}; {s.least:.2f} to {s.most:.2f})" if s.n else "?"


def finite(value: Any) -> Any:
    """The same for JSON, which has neither NaN nor infinity: null instead."""
    if isinstance(value, Mapping):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
