"""``quest calibrate`` and ``quest eval-monitor``: fit the monitor to recorded streams, and judge it on others."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from quest.cli.console import Console
from quest.cli.takes import open_store, say_corrupt, takes_to_choose_by
from quest.errors import ConfigError, InputError
from quest.monitor import Budget, Calibration, write_calibrations
from quest.wording import counted

if TYPE_CHECKING:
    from quest.evaluation.detectors import Detector
    from quest.evaluation.stream_record import StreamRecord


@dataclass(frozen=True)
class Calibrate:
    """Fit the monitor on validation objects and write its file, which `quest track --monitor` reads.

    Every view of every take is tracked once with depth and once by colours alone, and what the tracker says of losses
    is kept in --records, so that an interrupted run goes on where it stopped. Your own objects, which are in no part of
    the split, count as validation objects here: name stores that did not teach.
    """

    takes: tuple[str, ...]
    """Stores with takes of validation objects, or of your own."""
    records: Path
    """Folder for the recorded streams."""
    out: Path = Path("monitor.json")
    """File to write."""
    weights: str = "quest-s16"
    """Name or file of the weights."""
    inputs: tuple[Literal["depth", "colours"], ...] = ("depth", "colours")
    """What the streams bring that it is fitted to; each gets a calibration of its own."""
    level: tuple[int, ...] = ()
    """Levels of the takes to use; all by default."""
    shard: str = "0/1"
    """Part of the streams to record, such as 0/2 and 1/2 for two processes side by side; the last one fits."""
    block_frames: int | None = None
    """Length of the streams that thresholds rest on; that of the shortest by default."""
    unit: Literal["object", "take"] = "object"
    """Subject of the promise: other objects, or other takes of these objects (where there are few objects)."""

    def run(self) -> int:
        """Record, fit, write the file."""
        from quest.evaluation.calibrate import fit_calibration
        from quest.evaluation.selection import Shard
        from quest.evaluation.stream_record import record_streams
        from quest.track import load

        if not self.inputs or (self.block_frames is not None and self.block_frames < 1):
            raise ConfigError(f"calibrate: expected inputs, and block_frames of at least 1 if any, got {self}")
        console = Console()
        takes = takes_to_choose_by(self.takes, levels=self.level)
        tracker = load(self.weights, monitor=False)
        streams, missing = {}, 0
        for inputs in self.inputs:
            recorded = record_streams(
                tracker,
                takes,
                self.records,
                inputs=inputs,
                shard=Shard.parse(self.shard),
                progress=lambda name, done, total: console.print(f"{done + 1}/{total} {name}"),
            )
            streams[inputs] = recorded.records
            missing += recorded.missing
        if missing:
            console.print(f"left to other shards: {counted(missing, 'stream')}; nothing is fitted yet")
            return 0
        calibrations = {}
        for inputs, records in streams.items():
            fitted = fit_calibration(records, block_frames=self.block_frames, unit=self.unit)
            made = calibrations[inputs] = fitted.calibration
            console.print(
                f"{inputs}: {made.about}; alpha of at least {made.least_alpha:.3g} can be promised. AUROC "
                f"{fitted.auroc:.4f}, cross-validated ECE {fitted.ece:.4f}, mean delay {fitted.delay:.1f} frames; "
                f"slope {made.slope}, shift {made.shift}, {made.statistic}"
            )
        write_calibrations(self.out, calibrations)
        console.print(f"wrote {self.out}")
        return 0


@dataclass(frozen=True)
class EvalMonitor:
    """Judge the monitor on takes: a table in the terminal and, with --out, a result file.

    Every view of every take is tracked once with alarms off, and what the tracker says of losses is kept in --records;
    the monitor, and CUSUM, Page-Hinkley and a threshold on the tracker's own probability, are then played on that, all
    calibrated on the same streams. A monitor that was calibrated with --unit take is judged by other takes of the same
    objects: every take then counts as an object.
    """

    takes: tuple[str, ...]
    """Stores with takes of objects that took no part in the calibration."""
    records: Path
    """Folder for the recorded streams."""
    calibration: Path
    """Folder of the streams that the monitor was calibrated on."""
    weights: str = "quest-s16"
    """Name or file of the weights."""
    monitor: Path | None = None
    """File of `quest calibrate`; default: the monitor's calibrations that ship."""
    inputs: Literal["depth", "colours"] = "depth"
    """What the streams bring."""
    split: tuple[Literal["validation", "test", "unlisted"], ...] = ("test",)
    """Parts of the object split."""
    level: tuple[int, ...] = ()
    """Levels to evaluate; all by default."""
    alpha: tuple[float, ...] = (0.01, 0.05, 0.1)
    """Shares of loss-free streams that may alarm."""
    alpha_frames: int | None = None
    """--alpha is for every so many frames of a stream instead; a multiple of the calibration's blocks."""
    shard: str = "0/1"
    """Part of the streams to record, such as 0/2 and 1/2 for two processes side by side; the last one judges."""
    resamples: int = 200
    """Of the bootstrap over objects."""
    seed: int = 0
    """Of the bootstrap."""
    out: Path | None = None
    """Result file (.json)."""

    def run(self) -> int:
        """Record, judge, print the table, write the file."""
        from quest.evaluation.drift_report import TABLE_WIDTH, drift_rows, drift_table, write_drift
        from quest.evaluation.results import Run
        from quest.evaluation.selection import Shard, hash_of, select_takes
        from quest.evaluation.stream_record import by_unit, read_records, record_streams, tracker_id
        from quest.track import load

        budgets = [Budget(alpha, self.alpha_frames) for alpha in self.alpha]
        if self.resamples < 1 or self.seed < 0 or not budgets:
            raise ConfigError(f"eval-monitor: expected resamples >= 1, seed >= 0 and at least one alpha, got {self}")
        start_s = time.monotonic()
        console = Console(stderr=True, soft_wrap=False)
        tracker = load(self.weights, monitor=self.monitor or True)
        calibration = tracker.calibrations.get(self.inputs)
        if calibration is None:
            raise ConfigError(f"eval-monitor: there is no calibration for {self.inputs}; run `quest calibrate` first")
        block_frames = calibration.block_frames
        if self.alpha_frames is not None and self.alpha_frames % block_frames:
            raise ConfigError(
                f"eval-monitor: expected --alpha-frames as a multiple of the calibration's {block_frames} frames, got "
                f"{self.alpha_frames}"
            )
        stores = [open_store(path) for path in self.takes]
        say_corrupt(stores)
        takes = [(s, select_takes(s.infos(), split=self.split, levels=self.level)) for s in stores]
        recorded = record_streams(
            tracker,
            takes,
            self.records,
            inputs=self.inputs,
            shard=Shard.parse(self.shard),
            progress=lambda name, done, total: console.print(f"{done + 1}/{total} {name}"),
        )
        if recorded.missing:
            console.print(f"left to other shards: {counted(recorded.missing, 'stream')}; nothing is judged yet")
            return 0
        known = read_records(self.calibration, inputs=self.inputs, made_by=tracker_id(tracker))
        known = [r for r in known if r.part == "validation"]
        unit = calibration.unit
        streams, known = by_unit(recorded.records, unit), by_unit(known, unit)
        if unit == "take":
            console.print("calibrated on takes of the same objects: every take counts as an object")
        both = {r.object_id for r in known} & {r.object_id for r in streams}
        if both:
            raise ConfigError(f"{', '.join(sorted(both)[:3])}: the monitor was calibrated on them; use others")
        detectors = self._detectors(calibration, known)
        bootstrap: dict[str, Any] = {"resamples": self.resamples, "seed": self.seed}
        rows = drift_rows(detectors, streams, budgets=budgets, **bootstrap)
        Console(width=TABLE_WIDTH, soft_wrap=False, markup=True).print(drift_table(rows))
        if self.out is not None:
            made_of = {"weights": self.weights, "weights_hash": tracker.weights_hash}
            run = Run.ended(start_s, data_hash=hash_of(takes), **made_of, **bootstrap)
            write_drift(rows, run, calibration.about, self.out)
            console.print(f"wrote {self.out}")
        return 0

    def _detectors(self, calibration: Calibration, known: Sequence[StreamRecord]) -> tuple[Detector, ...]:
        """The monitor and the rules that it is compared with, on the streams that it was calibrated on."""
        from quest.evaluation.detectors import our_monitor, rivals

        others, expected = rivals(known, block_frames=calibration.block_frames), len(calibration.maxima)
        if len(others[0].maxima) != expected:
            raise InputError(
                f"calibration {self.calibration}: expected the streams that the monitor was calibrated on, {expected} "
                f"of which give thresholds, got {len(others[0].maxima)}; keep others in another folder"
            )
        return our_monitor(calibration), *others
