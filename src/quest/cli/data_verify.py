"""``quest data verify``: do the truths of stored takes agree with each other and with the images?"""

from __future__ import annotations

import itertools
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from quest.cli.data_stats import finite
from quest.cli.progress import counting
from quest.wording import counted

if TYPE_CHECKING:
    from quest.data.store import TakeStore
    from quest.data.verify import StoreReport


@dataclass(frozen=True)
class DataVerify:
    """Check takes: hashes, re-projection, rigid links, joints, flow, velocities, visibility, masks."""

    takes: Annotated[str, tyro.conf.Positional]
    """Folder or URL of a store, or of one take (STORE/NAME.zarr)."""

    json: Path | None = None
    """Also write to this file which takes pass, why the others fail, and the worst of each check."""

    def run(self) -> int:
        """Print a table of the worst of each check; returns 1 if a take fails."""
        from rich.console import Console

        from quest.cli.takes import open_takes
        from quest.data.verify import TakeReport, verify_store
        from quest.errors import TakeError

        store, names = open_takes(self.takes)
        chosen = names if names is not None else sorted({*store.names(), *store.problems()})
        if not chosen:
            raise TakeError(f"store {self.takes}: no takes; check the path, or generate takes into it")
        errors = Console(stderr=True, highlight=False, markup=False)
        with counting(errors, "verifying", len(chosen), "takes") as report:
            done = itertools.count(1)

            def checked(take: TakeReport) -> None:
                if not take.passed:
                    errors.print(take.message(), style="red", soft_wrap=True)
                report(next(done))

            found = verify_store(store, chosen, report=checked)
        if self.json is not None:
            _write(found, store, self.json)
        _print(found)
        return 0 if found.passed else 1


def _print(found: StoreReport) -> None:
    from rich.table import Table

    from quest.cli.takes import wide_console

    table = Table(box=None)
    for title in ("check", "worst", "at most", "failed takes", "where the worst is"):
        table.add_column(title, overflow="fold", no_wrap=title == "check")
    for name in found.check_names():
        worst = found.worst(name)
        assert worst is not None
        take, check = worst
        failed = sum(not c.passed for report in found.takes for c in [report.worst(name)] if c is not None)
        where = f"{take}: {check.where}" if check.worst > 0 else ""
        unit = f" {check.unit}" if check.unit else ""
        style = "red" if failed else None
        table.add_row(name, f"{check.worst:.3g}{unit}", f"{check.limit:.3g}{unit}", str(failed), where, style=style)
    console = wide_console()
    if table.row_count:
        console.print(table)
    frames = sum(report.frames * report.views for report in found.takes)
    console.print(
        f"{len(found.takes) - len(found.failed)} of {counted(len(found.takes), 'take')} pass, "
        f"{counted(frames, 'frame')}",
        style="green" if found.passed else "bold red",
    )


def _write(found: StoreReport, store: TakeStore, path: Path) -> None:
    from quest.data.provenance import code_commit, combined_hash, command_line, machine
    from quest.evaluation.report import write_report

    headers = store.headers()
    known = {report.name: headers[report.name] for report in found.takes if report.name in headers}
    worst = {name: pair for name in found.check_names() if (pair := found.worst(name)) is not None}
    result = {
        "passed": found.passed,
        "n_takes": len(found.takes),
        "n_frames": sum(report.frames * report.views for report in found.takes),
        "suites": dict(Counter(header.info.suite for header in known.values()).most_common()),
        "failed": {report.name: report.message() for report in found.failed},
        "worst": {name: {"take": take, **asdict(check)} for name, (take, check) in worst.items()},
        "takes": {report.name: report.passed for report in found.takes},
        "data_hash": combined_hash((name, header.data_hash) for name, header in known.items()),
        "commit": code_commit(),
        "machine": machine(),
        "command": command_line(),
    }
    write_report(finite(result), path)
