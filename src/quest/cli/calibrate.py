"""``quest calibrate``: fit the monitor to recorded streams."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rich.markup import escape

from quest.cli.console import Console
from quest.wording import counted


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
        """Record, fit, write the file.

        Raises:
            ConfigError: bad settings, or streams that do not suffice.
            TakeError: a take cannot be read; those whose description is corrupt are named and omitted.
        """
        from quest.cli.takes import takes_to_choose_by
        from quest.errors import ConfigError
        from quest.evaluation.calibrate import fit_calibration
        from quest.evaluation.selection import Shard
        from quest.evaluation.stream_record import record_streams
        from quest.monitor import write_calibrations
        from quest.track import load

        if not self.inputs or (self.block_frames is not None and self.block_frames < 1):
            raise ConfigError(f"calibrate: expected inputs, and block_frames of at least 1 if any, got {self}")
        console = Console(highlight=False, soft_wrap=True)
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
                progress=lambda name, done, total: console.print(f"{done + 1}/{total} {escape(name)}"),
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
        console.print(f"wrote {escape(str(self.out))}")
        return 0
