"""Write docs/results.md out of the report files below benchmarks/results.

    python benchmarks/update_reports.py            # rewrite docs/results.md
    python benchmarks/update_reports.py --check    # fail if it would change

What `quest eval` measures is in the README (`update_readme.py`); this page has the rest. Nothing in it is typed in.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tyro

ROOT = Path(__file__).parents[1]


@dataclass(frozen=True)
class Table:
    """One table of the page.

    Attributes:
        file: report, below the folder of results.
        title: heading.
        rows: key of the rows in the report: a list, or a mapping whose keys become the column ``key``; empty if the
            report itself is the only row.
        columns: headings and where in a row the value is, as keys joined by dots; ``%`` before it for percent.
        each: key of a list in a row of which every entry makes a line; its values come after ``each.``.
        only: values that a row must have; the others are in the report alone.
    """

    file: str
    title: str
    rows: str
    columns: dict[str, str]
    each: str = ""
    only: dict[str, Any] = field(default_factory=dict)


def _ablation(file: str, title: str, columns: dict[str, str]) -> Table:
    """A table of variants, moved entities alone; Δ is the difference from the variant's reference."""
    about = {"objects": "source", "suite": "suite", "protocol": "protocol", "level": "level", "variant": "variant"}
    counts = {"objects/takes/tracks": "objects/takes/tracks"}
    return Table(f"ablations/{file}.json", title, "rows", about | counts | columns, only={"reading": "moved"})


def _intents(file: str, title: str) -> Table:
    shares = {"both stable %": "%both", "both on their link %": "%kept", "APE open": "open_ape", "APE lift": "lift_ape"}
    right = {"Acc open %": "%open_acc", "Acc lift %": "%lift_acc"}
    right |= {"bound open": "open_bound", "bound lift": "lift_bound"}
    counts = {"objects/takes/views": "objects/takes/views"}
    return Table(f"intents/{file}.json", title, "rows", OBJECTS | counts | shares | right)


def _alarms(file: str, title: str) -> Table:
    about = {"detector": "detector", "alpha": "each.alpha", "in frames": "each.alpha_frames"}
    about |= {"fitted tail": "each.extrapolated"}
    false = {"loss-free streams": "each.trials", "false alarms": "each.false_alarms"}
    false |= {"95 % from": "%each.low", "to": "%each.high"}
    found = {"missed %": "%each.missed", "delay median": "each.delay_median", "p90": "each.delay_p90"}
    return Table(f"{file}.json", title, "rows", OBJECTS | about | false | found, each="alarms")


def _tracking(file: str, title: str) -> Table:
    """What `quest eval` says of moved entities."""
    about = {
        "protocol": "protocol",
        "suite": "suite",
        "level": "level",
        "tracker": "tracker",
        "objects/takes/tracks": "objects/takes/tracks",
    }
    metrics = {"APE": "metrics.ape", "D@100": "metrics.d100", "Acc %": "%metrics.acc", "slope": "metrics.slope"}
    return Table(file, title, "rows", OBJECTS | about | metrics, only={"reading": "moved"})


OBJECTS = {"objects": "source", "part": "part"}
ON_OFF = {
    "objects/tracks": "objects/tracks",
    "APE on": "ape.on",
    "off": "ape.off",
    "ratio": "ape.ratio",
    "well seen: on": "well_seen.on",
    "off ": "well_seen.off",
    "difference": "well_seen.difference",
}
PARTS = {
    "APE": "metrics.ape",
    "D@100": "metrics.d100",
    "Acc": "metrics.acc",
    "recall": "metrics.recall",
    "ΔAPE": "difference.ape",
    "ΔD@100": "difference.d100",
    "ΔAcc": "difference.acc",
}
SIZES = {
    "APE_2d": "metrics.ape_2d",
    "D@100": "metrics.d100",
    "Acc": "metrics.acc",
    "ΔAPE_2d": "difference.ape_2d",
    "ΔD@100": "difference.d100",
    "ΔAcc": "difference.acc",
}
TABLES = (
    _ablation("parts", "What queries, 3D, smoothness, joints and anchors are worth", PARTS),
    _ablation("window", "Windows of T frames", SIZES),
    _ablation("slots", "K learned queries", SIZES),
    _ablation("losses", "Every loss left out by itself", PARTS),
    _ablation("design", "Heatmap against regression, anchors against learned queries, 3D position codes", PARTS),
    _ablation("data", "Trained on procedural objects only", PARTS),
    _tracking("quest-s16-apache/test.json", "Released weights that learned from procedural objects only"),
    Table(
        "monitor/test.json",
        "Drift per frame: the monitor beside plainer rules",
        "rows",
        OBJECTS
        | {
            "detector": "detector",
            "streams": "streams",
            "losses": "losses",
            "AUROC": "auroc",
            "AUGRC": "augrc",
            "ECE": "ece",
        },
    ),
    _alarms("monitor/test", "Alarms per stream, at equal false alarms"),
    _alarms("monitor/blocks", "The same streams, alpha for every 60 frames"),
    _alarms("monitor/long", "Streams of 240 frames, alpha for the whole stream"),
    _alarms("monitor/long_blocks", "Streams of 240 frames, alpha for every 60 frames"),
    _alarms("quest-s16-apache/monitor/test", "Alarms per stream, weights that learned from procedural objects only"),
    Table(
        "grounding/standard_grounding.json",
        "Grounding on against off, ordinary takes",
        "rows",
        OBJECTS | {"level": "level"} | ON_OFF,
    ),
    Table(
        "grounding/suites_grounding.json",
        "Grounding on against off, suites",
        "rows",
        OBJECTS | {"suite": "suite"} | ON_OFF,
    ),
    Table(
        "grounding/reappearance.json",
        "Suite occlusion: hidden for 60 frames while the joint moves on and stops",
        "occlusion",
        OBJECTS
        | {
            "beside": "beside",
            "tracker": "tracker",
            "hidden/judged": "episodes/judged",
            "right before %": "%held_before",
            "APE hidden": "ape_hidden",
            "right 5 frames after %": "%held_again",
            "of those right before %": "%held_again_if_before",
            "median then": "distance_again",
        },
    ),
    Table(
        "grounding/reappearance.json",
        "Suite lockers: sixteen identical doors",
        "lockers",
        OBJECTS
        | {
            "reading": "reading",
            "tracker": "tracker",
            "objects/tracks": "objects/tracks",
            "switches per 1,000 frames": "metrics.switches",
            "Acc %": "%metrics.acc",
        },
    ),
    Table(
        "joints/joints.json",
        "Joints from true tracks with noise (2 mm unless said), after 30 degrees or 10 cm",
        "simulated",
        {"how": "key", "tracks": "all.kind_right.n", "kind right %": "%all.kind_right"}
        | {f"axis error {kind}, degrees": f"{kind}.axis_error_deg.median" for kind in ("prismatic", "revolute")}
        | {f"best possible, {kind}": f"best_possible_axis_error_deg.{kind}" for kind in ("prismatic", "revolute")},
    ),
    Table(
        "joints/joints.json",
        "Joints from real tracks that move that far",
        "recorded",
        {"how": "key", "tracks": "kind_right.n", "kind right %": "%kind_right"},
    ),
    Table(
        "grounding/predicted_joints.json",
        "Joints from predicted tracks",
        "rows",
        OBJECTS
        | {
            "joint": "kind",
            "when": "moment",
            "objects/answers": "objects/answers",
            "kind right %": "%kind_right",
            "axis error, degrees": "axis_error_deg",
            "p90": "axis_p90_deg",
        },
    ),
    _tracking("fine_tune/before.json", "The tool chest of examples/fine_tune.py, shipped weights"),
    _tracking("fine_tune/after.json", "The same takes, weights that were fitted to it"),
    _tracking("levels/test.json", "Levels 1 to 4 of the same objects"),
    _tracking("robust/test.json", "Noise on the colours, and a camera position never trained on"),
    _intents("intents", "Open and lift: two places of one label on one thing, both asked for"),
    _intents("ajar", "The same, begun where both are seen 16 pixels apart"),
    Table(
        "scene_flow/test.json",
        "Scene flow: EPE3D of the flow head beside zero flow and differences of lifted points",
        "rows",
        OBJECTS
        | {
            "level": "level",
            "stride": "stride",
            "reading": "reading",
            "objects/takes/entities": "objects/takes/entities",
            "flow head": "epe.head",
            "zero": "epe.zero",
            "lifted, as predicted": "epe.lifted",
        },
    ),
    Table(
        "endurance/endurance.json",
        "One stream for a long time: memory since frame 10,000, processor time per frame early and late",
        "",
        {
            "frames": "frames_done",
            "memory at the end +%": "memory_growth_percent.end",
            "at most +%": "memory_growth_percent.peak",
            "early, ms": "cpu_change.early_ms",
            "late, ms": "cpu_change.late_ms",
            "change %": "cpu_change.percent",
        },
    ),
    Table(
        "speed/tracking.json",
        "A stream of the packaged clip with alarms on: milliseconds per frame",
        "rows",
        {
            "queries": "queries",
            "turns": "turns",
            "frames": "frames",
            "median": "median_ms",
            "95 of 100 within": "p95_ms",
            "frames/s": "frames_per_s",
        },
    ),
    Table(
        "speed/tracking.json",
        "The first frame of such a stream, in which everything is discovered",
        "",
        {"device": "device", "threads": "threads", "times": "discovery_ms.n", "median, ms": "discovery_ms.median"},
    ),
    Table(
        "data/verify.json",
        "Takes of all suites, verified",
        "worst",
        {"check": "key", "worst": "worst", "at most": "limit", "unit": "unit", "where the worst is": "take"},
    ),
    Table(
        "speed/generation.json",
        "Making takes, three views of 224 pixels, beside a bare SAPIEN loop",
        "",
        {
            "takes": "n_takes",
            "frames": "n_frames",
            "frames/s": "frames_per_s",
            "bare loop": "bare_frames_per_s",
            "share of bare %": "%share_of_bare",
            "of its processor time %": "%share_of_bare_processor_time",
        },
    ),
    Table(
        "speed/training.json",
        "Training steps of the loop, beside bare steps of the same network",
        "",
        {
            "preset": "preset",
            "windows": "batch",
            "turns": "n_turns",
            "frames/s": "frames_per_s",
            "bare steps": "bare_frames_per_s",
            "share of bare %": "%share_of_bare",
        },
    ),
)


@dataclass(frozen=True)
class UpdateReports:
    """Rewrite the page of results."""

    out: Path = ROOT / "docs" / "results.md"
    results: Path = ROOT / "benchmarks" / "results"
    check: bool = False
    """Change nothing; exit with 1 if the page is out of date."""

    def run(self) -> int:
        """Return 0, or 1 if --check finds the page out of date."""
        text = page(self.results)
        if self.check:
            return int(not self.out.is_file() or self.out.read_text(encoding="utf-8") != text)
        self.out.write_text(text, encoding="utf-8")
        return 0


def page(folder: Path) -> str:
    """All reports of a folder as Markdown; those that are not there are left out."""
    parts = [
        "# Results of ablations, monitor, grounding, suites and simulator",
        "Written by `python benchmarks/update_reports.py` out of `benchmarks/results`; [metrics.md](metrics.md) says "
        "what the columns are. In brackets 95 % intervals: exact ones for false alarms, for what is right before and "
        "after being hidden and for joints from true and real tracks, else bootstraps over objects, of speeds over "
        "turns or takes. Validation objects chose settings; test objects did not. Every table names its commit. What "
        "commits before 3ce3175 say of discovery is of maps that learned from fewer objects. Tables of commits before "
        "7f76a48 are of a tracker that keeps a hinge even where the network is sure that it is wrong, those before "
        "69b1116 of one whose queries may begin in a look-alike of what they were bound to, those before "
        "8ca5ac4 of one that does not carry the point along either that was asked for, those before 3145cc6 of one "
        "that does not read how far the front of a link has turned.",
    ]
    parts += [_section(table, report) for table in TABLES if (report := _report(folder / table.file, table.rows))]
    return "\n\n".join(parts) + "\n"


def _report(path: Path, rows: str) -> dict[str, Any] | None:
    """A report; None where there is no such file, or nothing of this kind in it."""
    report = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    return report if report and (not rows or report.get(rows)) else None


def _section(table: Table, report: dict[str, Any]) -> str:
    lines = [_line(table.columns), _line(["---"] * len(table.columns))]
    rows = report[table.rows] if table.rows else [report]
    if isinstance(rows, dict):
        rows = [{"key": key, **row} for key, row in rows.items()]
    rows = [row for row in rows if all(row[key] == value for key, value in table.only.items())]
    for row in rows:
        for entry in row[table.each] if table.each else [{}]:
            lines.append(_line([_cell(row | {"each": entry}, where) for where in table.columns.values()]))
    run = report.get("run", report)
    notes = [f"`{run['command']}`, commit {run['commit']}."]
    notes += [
        f"Answers: `{r['command']}`, commit {r['commit']}." for r in (o["run"] for o in report.get("origins", ()))
    ]
    if report.get("complete") is False:
        notes.insert(0, "**Unfinished**: the run was stopped before its last take; these are the takes so far.")
    if "n_takes" in report and "machine" in report:
        notes.insert(0, f"n = {report['n_takes']} takes, {report['machine']}.")
    if "steps" in report:
        seeds = ", ".join(map(str, report["seeds"]))
        notes.append(f"{report['steps']} steps of {report['batch']} windows each, on frozen features; seeds {seeds}.")
    if "calibration" in report:
        notes.append(f"Calibration: {report['calibration']}.")
    return "\n".join([f"## {table.title}", "", *lines, "", *notes])


def _cell(row: dict[str, Any], where: str) -> str:
    if "/" in where:
        return "/".join(_cell(row, part) for part in where.split("/"))
    percent, value = where.startswith("%"), row
    for key in where.lstrip("%").split("."):
        value = value.get(key) if isinstance(value, dict) else None
    return _shown(value, 100 if percent else 1)


def _shown(value: Any, factor: float) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else ""
    if isinstance(value, dict):
        middle = _shown(value.get("share", value.get("mean")), factor)
        low, high = (_shown(value.get(key), factor) for key in ("low", "high"))
        return f"{middle} ({low}–{high or '∞'})" if low else middle
    if isinstance(value, float):
        if factor == 100:
            return f"{factor * value:.{int(0 < abs(value) < 0.1)}f}"
        return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return str(value)


def _line(cells: Any) -> str:
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    sys.exit(tyro.cli(UpdateReports).run())
