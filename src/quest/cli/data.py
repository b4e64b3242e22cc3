"""``quest data``: look at takes, check them, say what is in a store, and hand takes to others in their formats."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro
from rich.table import Table

from quest.cli.console import Console
from quest.cli.progress import counting
from quest.cli.takes import (
    check_picture,
    no_takes,
    open_store,
    open_takes,
    say_corrupt,
    say_omitted,
    table_console,
    write_picture,
)
from quest.errors import ConfigError, TakeError
from quest.wording import counted

if TYPE_CHECKING:
    from quest.data.stats import Spread, StoreStats
    from quest.data.store import TakeStore
    from quest.data.verify import Check, StoreReport, TakeReport
    from quest.types import Take

MOST_FRAMES_SHOWN = 600


@dataclass(frozen=True)
class DataExport:
    """Write takes as TAPVid-3D examples, a LeRobot dataset, or MCAP recordings.

    Exit code 1 if takes of the store cannot be read and were omitted.
    """

    takes: tyro.conf.Positional[str]
    """Folder or URL of a store, or of one take (STORE/NAME.zarr)."""
    out: Path
    """Folder to write into: one .npz per view (tapvid3d), one dataset (lerobot), one .mcap per view (mcap)."""
    format: Literal["tapvid3d", "lerobot", "mcap"] = "tapvid3d"
    """Format of the files."""
    depth: bool = False
    """Of tapvid3d: write depth too, with which quest bench tapvid also judges points in space."""

    def run(self) -> int:
        """Write, and print the files."""
        if self.depth and self.format != "tapvid3d":
            raise ConfigError(f"data export: --depth is for tapvid3d; {self.format} has depth anyway")
        store, one = open_takes(self.takes)
        names = [one] if one else store.names()
        if not names:
            raise no_takes(store, self.takes)
        corrupt = 0 if one else say_corrupt([store])
        if self.format == "lerobot":
            self._write_dataset(store, names)
            return 1 if corrupt else 0
        for name in names:
            try:
                take = store.read(name)
            except TakeError as error:
                if one:
                    raise
                corrupt += say_omitted(str(error))
                continue
            for path in self._write_take(take):
                print(path)
        return 1 if corrupt else 0

    def _write_dataset(self, store: TakeStore, names: list[str]) -> None:
        """One episode per take, with as many places for joints and entities as the take with the most has."""
        from quest.data.lerobot_export import Episode, export_lerobot
        from quest.types import LABELS

        infos = [store.header(name).info for name in names]
        episodes = export_lerobot(
            (Episode.of_take(store.read(name)) for name in names),
            self.out,
            joints=max(len(info.joints) for info in infos),
            entities=max(sum(entity.label in LABELS for entity in info.entities) for info in infos),
        )
        print(f"{self.out}: {counted(episodes, 'episode')}")

    def _write_take(self, take: Take) -> list[Path]:
        """One file per view; those of MCAP have the true tracks beside the images."""
        from quest.data.export_tapvid3d import export_tapvid3d
        from quest.data.lerobot_export import Episode
        from quest.data.mcap_export import export_mcap

        if self.format == "tapvid3d":
            return export_tapvid3d(take, self.out, depth=self.depth)
        files = [self.out / f"{take.info.name}-v{v}.mcap" for v in range(len(take.views))]
        for v, (view, path) in enumerate(zip(take.views, files, strict=True)):
            export_mcap(view.clip, path, tracks=Episode.of_take(take).tracks[f"view_{v}"])
        return files


@dataclass(frozen=True)
class DataStats:
    """Count the takes of a store, the share that is visible, the motion, and the missing depth."""

    store: tyro.conf.Positional[str]
    """Folder or URL of takes."""
    json: Path | None = None
    """Also write the numbers to this file."""

    def run(self) -> int:
        """Print a table; returns 0."""
        from quest.data.stats import store_stats
        from quest.evaluation.results import write_report

        store = open_store(self.store)
        with counting(Console(stderr=True), "reading", None, "takes") as report:
            found = store_stats(store, report=report)
        say_corrupt([store])
        if self.json is not None:
            write_report(_finite(asdict(found)), self.json)
        table = Table(box=None, show_header=False)
        table.add_column(no_wrap=True, style="dim")
        table.add_column(overflow="fold")
        for name, value in _stats_in_words(found).items():
            table.add_row(name, value)
        table_console().print(table)
        return 0


def _stats_in_words(found: StoreStats) -> dict[str, str]:
    def counts(each: Mapping[str, int]) -> str:
        return ", ".join(f"{name} ({count})" for name, count in each.items()) or "none"

    def percent(share: float) -> str:
        return "?" if math.isnan(share) else f"{100 * share:.1f} %"

    def spread(s: Spread) -> str:
        return f"{s.median:.2f} ({s.low:.2f} to {s.high:.2f}; {s.least:.2f} to {s.most:.2f})" if s.n else "?"

    unreadable = f"; {found.unreadable} cannot be read" if found.unreadable else ""
    views = f"{found.frames} in {counted(found.views, 'view')}, {found.hours:.2f} hours"
    missing = f"{percent(found.depth_missing_share)} of all pixels"
    missing_on_object = f"{percent(found.depth_missing_share_on_object)} of the objects'"
    labels = ", ".join(f"{label} {percent(share)}" for label, share in found.visible_share_by_label.items())
    visible = f"{percent(found.visible_share)} of frames, entities and views"
    return {
        "takes": f"{found.takes} of {counted(found.objects, 'object')}{unreadable}",
        "frames": f"{views}, pixels: {counts(found.image_px)}",
        "on disk": f"{found.stored_bytes / 1e9:.3f} GB",
        **{name: counts(getattr(found, name)) for name in ("sources", "categories", "levels", "suites")},
        "entities": counts(found.labels),
        "moving cameras": f"{found.moving_cameras} of {found.views} views",
        "depth": f"{found.with_depth_sensor} of {found.takes} takes through a sensor model; missing in {missing} and "
        f"{missing_on_object}",
        "visible": visible + (f" ({labels})" if labels else ""),
        "never seen": f"{percent(found.never_seen)} of entities and views",
        "moved": f"{percent(found.moved_share)} of entities, by more than 0.1 normalised units",
        "motion": f"{spread(found.motion)} normalised units; {spread(found.motion_m)} m",
        "object diagonal": f"{spread(found.diagonal_m)} m",
        "camera to entity": f"{spread(found.distance_m)} m",
        "": "ranges: median (10 % to 90 %; least to most)",
    }


def _finite(value: Any) -> Any:
    """The same for JSON, which has neither NaN nor infinity: null instead."""
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@dataclass(frozen=True)
class DataVerify:
    """Check takes: hashes, re-projection, rigid links, joints, flow, velocities, visibility, masks."""

    takes: tyro.conf.Positional[str]
    """Folder or URL of a store, or of one take (STORE/NAME.zarr)."""
    json: Path | None = None
    """Also write to this file which takes pass, why the others fail, and the worst of each check."""

    def run(self) -> int:
        """Print a table of the worst of each check; returns 1 if a take fails."""
        from quest.data.verify import verify_store

        store, one = open_takes(self.takes)
        names = [one] if one else sorted({*store.names(), *store.problems()})
        if not names:
            raise no_takes(store, self.takes)
        errors = Console(stderr=True)
        with counting(errors, "verifying", len(names), "takes") as report:
            done = itertools.count(1)

            def checked(take: TakeReport) -> None:
                if not take.passed:
                    errors.print(take.message(), style="red")
                report(next(done))

            found = verify_store(store, names, report=checked)
        frames = sum(report.frames * report.views for report in found.takes)
        worst = {name: pair for name in found.check_names() if (pair := found.worst(name)) is not None}
        if self.json is not None:
            self._write(found, store, frames, worst)
        table = Table(box=None)
        for title in ("check", "worst", "at most", "failed takes", "where the worst is"):
            table.add_column(title, overflow="fold", no_wrap=title == "check")
        for name, (take, check) in worst.items():
            failed = sum(not c.passed for report in found.takes for c in [report.worst(name)] if c is not None)
            where = f"{take}: {check.where}" if check.worst > 0 else ""
            unit = f" {check.unit}" if check.unit else ""
            style = "red" if failed else None
            table.add_row(name, f"{check.worst:.3g}{unit}", f"{check.limit:.3g}{unit}", str(failed), where, style=style)
        console = table_console()
        if table.row_count:
            console.print(table)
        passed = f"{len(found.takes) - len(found.failed)} of {counted(len(found.takes), 'take')} pass"
        console.print(f"{passed}, {counted(frames, 'frame')}", style="green" if found.passed else "bold red")
        return 0 if found.passed else 1

    def _write(self, found: StoreReport, store: TakeStore, frames: int, worst: dict[str, tuple[str, Check]]) -> None:
        from quest.data.provenance import code_commit, combined_hash, command_line, machine
        from quest.evaluation.results import write_report

        assert self.json is not None
        headers = store.headers()
        known = {report.name: headers[report.name] for report in found.takes if report.name in headers}
        result = {
            "passed": found.passed,
            "n_takes": len(found.takes),
            "n_frames": frames,
            "suites": dict(Counter(header.info.suite for header in known.values()).most_common()),
            "failed": {report.name: report.message() for report in found.failed},
            "worst": {name: {"take": take, **asdict(check)} for name, (take, check) in worst.items()},
            "takes": {report.name: report.passed for report in found.takes},
            "data_hash": combined_hash((name, header.data_hash) for name, header in known.items()),
            "commit": code_commit(),
            "machine": machine(),
            "command": command_line(),
        }
        write_report(_finite(result), self.json)


@dataclass(frozen=True)
class DataShow:
    """Look at a take, or at several of a store: a contact sheet, or a Rerun recording."""

    takes: tyro.conf.Positional[str]
    """Folder or URL of a take (STORE/NAME.zarr), or of a store."""
    out: Path | None = None
    """Picture to write (PNG, JPEG, WebP); default: NAME.png in the current folder, unless Rerun is asked for."""
    columns: int = 8
    """Frames on the sheet, spread evenly: of one take from the first to the last, of several from the first on."""
    rows: int = 12
    """Takes on the sheet of a store, spread evenly over their names."""
    rrd: Path | None = None
    """Save a Rerun recording: images, depth as points, entities and trails, joint axes, cameras, masks, curves."""
    rerun: bool = False
    """Open Rerun's viewer."""
    every: int | None = None
    """Of a take, show every n-th frame only; default: 1, more for takes of more than 600 frames."""

    def run(self) -> int:
        """Write the picture or the recording and say where it is."""
        if (self.every is not None and self.every < 1) or self.rows < 1 or self.columns < 1:
            raise ConfigError("show: expected --every, --rows and --columns of at least 1")
        if self.out is not None:
            check_picture("show", self.out)
        store, one = open_takes(self.takes)
        if one:
            self._show_take(store, one)
        elif self.rrd is not None or self.rerun or self.every is not None:
            example = next(iter(store.names()), "NAME")
            raise TakeError(
                f"show: --rrd, --rerun and --every are for one take, and {self.takes} is a store; name one, such as "
                f"{self.takes.rstrip('/')}/{example}.zarr"
            )
        else:
            self._show_store(store)
        return 0

    def _show_take(self, store: TakeStore, name: str) -> None:
        every = self.every or -(-store.header(name).frames // MOST_FRAMES_SHOWN)
        take = store.read(name, frames=slice(None, None, every))
        if self.rrd is not None or self.rerun:
            from quest.viz.rerun_log import save_rrd

            if self.rrd is not None:
                save_rrd(take, self.rrd, every=every)
                megabytes = self.rrd.stat().st_size / 1e6
                print(f"{self.rrd}: {megabytes:.1f} MB, take {name}; open it with: rerun {self.rrd}")
            if self.rerun:
                save_rrd(take, None, every=every)
        if self.out is not None or not (self.rrd or self.rerun):
            from quest.viz.contact_sheet import contact_sheet

            sheet = contact_sheet(take, columns=self.columns, every=every)
            write_picture(sheet, self.out or Path(f"{name}.png"), f"take {name}")

    def _show_store(self, store: TakeStore) -> None:
        from quest.viz.contact_sheet import takes_sheet

        headers = store.headers()
        if not headers:
            raise no_takes(store, self.takes)
        names = list(headers)
        picked = sorted({round(i * (len(names) - 1) / max(self.rows - 1, 1)) for i in range(self.rows)})
        takes = []
        for name in (names[i] for i in picked):
            step = max(1, (headers[name].frames - 1) // max(self.columns - 1, 1))
            takes.append(store.read(name, views=[0], frames=slice(None, None, step)))
        title = f"{self.takes}: {len(takes)} of {len(names)} takes"
        where = str(store.root.resolve()) if store.is_folder else self.takes
        name = where.rstrip("/\\").replace("\\", "/").rpartition("/")[2] or "takes"
        sheet = takes_sheet(takes, title=title, columns=self.columns)
        write_picture(sheet, self.out or Path(f"{name}.png"), counted(len(takes), "take"))


@dataclass(frozen=True)
class DataLs:
    """List the takes of a store, and the faults of those that cannot be read."""

    store: tyro.conf.Positional[str]
    """Folder or URL of takes."""

    def run(self) -> int:
        """Print a table; returns 1 if a take is corrupt."""
        store, one = open_takes(self.store)
        table = Table(box=None)
        table.add_column("take", no_wrap=True)
        for title in ("suite", "category", "level", "frames", "views", "entities", "MB", "data hash"):
            right = title in ("level", "frames", "views", "entities", "MB")
            table.add_column(title, overflow="fold", justify="right" if right else "left")
        headers = {name: header for name, header in store.headers().items() if one in (None, name)}
        problems = {name: text for name, text in store.problems().items() if one in (None, name)}
        if one and not headers and not problems:
            store.header(one)  # says that there is none
        for name, header in headers.items():
            info = header.info
            counts = map(str, (info.level, header.frames, len(header.cameras), len(info.entities)))
            megabytes = f"{sum(header.files.values()) / 1e6:.1f}"
            table.add_row(name, info.suite, info.category, *counts, megabytes, header.data_hash[:12])
        console = table_console()
        console.print(table)
        frames = sum(header.frames * len(header.cameras) for header in headers.values())
        console.print(f"{counted(len(headers), 'take')}, {counted(frames, 'frame')}", style="dim")
        for problem in problems.values():
            Console(stderr=True).print(problem, style="red")
        return 1 if problems else 0
