"""Write the tables of the README, the model cards and the pages of results out of the result files.

    python benchmarks/update_pages.py            # rewrite what is out of date
    python benchmarks/update_pages.py --check    # fail if a page would change

The README and the cards keep their text around a pair of markers; the pages of results are written whole.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import tyro

from quest.bench.tables import TABLES
from quest.bench.writing import Table, cell, line, markdown, matches
from quest.model.weights import DEFAULTS
from quest.wording import counted

ROOT = Path(__file__).parents[1]
CARDS = ROOT / "src" / "quest" / "assets" / "weights"
BEGIN, END = "<!-- figures:begin -->", "<!-- figures:end -->"


@dataclass(frozen=True)
class Page:
    """A page that is written whole."""

    title: str
    about: str
    tables: tuple[Table, ...]


BEFORE_FILTER = {
    **dict.fromkeys(("34e4f3300", "5f5f33ce9", "dd00f5924", "6ee9a5e76", "4383e9a2b", "cf90a39a8"), ""),
    "13a04d4e3": "; `quest-filter` is the filter as it was then",
}
"""Commits whose results are of the tracker before the filter, and what to add to that."""

MOVED = {"protocol": "point", "reading": "moved"}
FOUND = {"protocol": "semantic", "reading": "all"}
OBJECTS = "objects = source | part = part | "
TRACKS = "objects/takes/tracks = objects/takes/tracks | "


def tracking(file: str, title: str, about: str = "", **only: Any) -> Table:
    """Points that were asked for, of entities that move."""
    columns = f"{OBJECTS}level = level | suite = suite | tracker = tracker | {TRACKS}"
    metrics = "median px = metrics.median_px | APE = metrics.ape | Acc % = %metrics.acc"
    return Table(file, title, columns + metrics, only=MOVED | only, about=about)


def real_tracks(file: str, title: str, of: str, about: str = "") -> Table:
    """Points that were asked for in real recordings."""
    counts = "tracker = tracker | shown = inputs | clips/tracks/labels = units/targets/terms | "
    errors = "median px = measures.median_px | within 16 px % = %measures.within_16 | "
    errors += "moved: within 16 px % = %measures.moved_within_16 | identity errors % = %measures.identity_errors | "
    errors += "never beyond 50 px % = %measures.never_beyond_50 | "
    hidden = "not visible, called visible % = %measures.hidden_called_visible | "
    lost = "P(lost) near = measures.lost_p_near | P(lost) far = measures.lost_p_far"
    return Table(f"real/{file}.json", title, counts + errors + hidden + lost, only={"of": of}, about=about)


def found(file: str, title: str, about: str = "") -> Table:
    """Handles and knobs in single pictures."""
    columns = "tracker = tracker | shown = inputs | pictures/handles/answers = units/targets/terms | not found % = "
    columns += "!%measures.recall | precision % = %measures.precision | F1 % = %measures.f1 | AP = measures.ap"
    return Table(f"real/{file}.json", title, columns, only={"of": "pictures"}, about=about)


def discovery(file: str, title: str, **only: Any) -> Table:
    """Entities that nobody pointed at; pixels of those that were not found mean nothing and are not shown."""
    found = "not found % = !%metrics.recall | nor under another label % = !%metrics.place_recall | "
    right = "precision % = %metrics.precision | Acc % = %metrics.acc"
    return Table(file, title, f"{OBJECTS}level = level | {TRACKS}{found}{right}", only=FOUND | only)


def per_frame(file: str, title: str) -> Table:
    """How well losses are told from the rest in every frame."""
    columns = "detector = detector | streams = streams | losses = losses | AUROC = auroc | AUGRC = augrc | ECE = ece"
    return Table(file, title, columns)


def alarms(file: str, title: str) -> Table:
    """False alarms and losses that were missed, at every alpha."""
    about = (
        "detector = detector | alpha = each.alpha | in frames = each.alpha_frames | extrapolated = each.extrapolated | "
    )
    false = "false alarms = each.false_alarms of each.trials | "
    false += "95 % interval, % = %each.low to %each.high | "
    found = "missed % = %each.missed | median delay = each.delay_median | 90 % within = each.delay_p90"
    return Table(file, title, about + false + found, each="alarms")


def intents(file: str, title: str) -> Table:
    """Two rims of one laptop, one to open and one to lift."""
    counts = f"{OBJECTS}objects/takes/views = objects/takes/views | "
    shares = "both stable % = %both | both on their link % = %kept | APE open = open_ape | APE lift = lift_ape"
    return Table(f"intents/{file}.json", title, counts + shares)


APACHE = "quest-s16-apache"

RESULTS = Page(
    "Results",
    "Figures of the weights that ship, real recordings first. Written by `python benchmarks/update_pages.py` out of "
    "`benchmarks/results`; [metrics.md](metrics.md) defines the columns. In brackets are 95 % intervals. Validation "
    "objects chose settings, test objects did not. Figures of earlier trackers are in "
    "[history/results.md](history/results.md).",
    (
        real_tracks("video", "Real videos of furniture and appliances", "tracks", "Colours; the camera is guessed."),
        real_tracks("posed", "Real rooms filmed by a moving depth camera", "tracks", "Nothing in the room moves."),
        real_tracks("posed", "The same with wide steps between frames", "tracks, wide steps"),
        found("images", "Finding: real pictures", "Handles and knobs; nothing is asked for."),
        found("posed", "Finding: stills of a kitchen"),
        Table(
            "real/images.json",
            "Finding: real pictures, boxes and sizes",
            "tracker = tracker | not found below 16 px % = !%measures.recall_0_to_16_px | 16 to 32 = "
            "!%measures.recall_16_to_32_px | 32 to 64 = !%measures.recall_32_to_64_px | above = "
            "!%measures.recall_above_64_px | AP50 handles = measures.ap50_handle | cabinet doors, drawers = "
            "measures.ap50_cabinet | doors = measures.ap50_door | refrigerator doors = measures.ap50_refrigerator | "
            "bare ones = measures.ap50_bare",
            only={"of": "pictures"},
            about="Sizes are longer sides in a picture 640 px wide.",
        ),
        tracking("test.json", "Simulated test objects", suite="standard"),
        discovery("test.json", "Discovery on test objects"),
        tracking(
            "suites.json",
            "Test objects in kitchens",
            "Nothing was trained on kitchens. From metres away the depth of the simulated sensor is noisy, has holes, "
            "and ends at 6.55 m: APE and Acc are poor also for points that rest in the picture. Takes: `quest generate "
            "--out runs/takes/suites --suite kitchen --split test --procedural 20 --mix broad --sensor stereo "
            "--every 2`.",
            suite="kitchen",
        ),
        discovery("suites.json", "Discovery in kitchens", suite="kitchen"),
        tracking(
            "suites.json",
            "Test objects that a hand pulls",
            "Takes: `quest generate --out runs/takes/suites --suite hands --split test --no-partnet --procedural 12 "
            "--mix broad --sensor stereo --size 480 --every 2`.",
            suite="hands",
        ),
        tracking(
            "free.json",
            "Free furniture",
            "Test objects of Sweet Home 3D's libraries, which taught nothing. Takes: `quest generate --out "
            "runs/takes/free-test --split test --no-partnet --imported free --mix broad --size 480 --sensor stereo "
            "--level 1 --views 1`.",
            suite="standard",
        ),
        discovery("free.json", "Discovery on free furniture"),
        discovery("fine_tune/before.json", "Discovery on the tool chest of examples/fine_tune.py, shipped weights"),
        discovery("fine_tune/after.json", "Discovery on the tool chest, weights taught by other takes of it"),
        Table(
            "predicted_joints.json",
            "Joints from predicted tracks",
            OBJECTS + "joint = kind | when = moment | objects/answers = objects/answers | kind right % = %kind_right | "
            "axis error, degrees = axis_error_deg | 90 % within = axis_p90_deg",
        ),
        Table(
            "several_views.json",
            "Several cameras",
            "tracks = source | of = reading | objects/tracks = objects/tracks | median error = error_median | "
            "median, cm = error_median_cm | right identity % = %right_identity | "
            "wrong frames called lost % = %loss_said | right frames called lost % = %false_loss",
            about="Simulated objects that nothing was trained on, three still cameras. Errors are in half diagonals.",
        ),
        Table(
            "doubt.json",
            "The network that tells a loss, with depth",
            "answers = answers | told by = by | n = n | lost % = %lost | AUROC = auroc | log-loss = log_loss | "
            "P(lost) at lost = p_lost_median | at right = p_right_median | 90 % below = p_right_90 | "
            "of lost above 0.5 % = %told_lost | of these right % = %told_rightly",
            about="Answers that taught nothing, before calibration: entities and points of simulated objects by "
            "networks that others taught, and four real recordings; beside a fit of the filter's own odds alone. "
            "P(lost) is a median. Takes: "
            "`quest generate --split train --no-partnet --procedural 110 --mix broad --level 1 --views 1 --size 480 "
            "--sensor stereo --out runs/takes/teach`, and with `--seeds 111..134 --camera mixed` in place of "
            "`--procedural 110` into `runs/takes/teach_moving`.",
        ),
        per_frame("monitor/test.json", "The monitor beside plainer rules, per frame"),
        alarms("monitor/test.json", "Alarms per stream, at equal false alarms"),
        per_frame("monitor/colours.json", "The same by colours alone, per frame"),
        alarms("monitor/colours.json", "Alarms by colours alone"),
        Table(
            "published.json",
            "The published network on new motions of the objects that taught",
            f"{OBJECTS}level = level | of = reading | tracker = tracker | {TRACKS}median px = metrics.median_px | "
            "APE = metrics.ape | D@100 = metrics.d100 | Acc % = %metrics.acc",
            about="quest: weights `quest-paper`, with all remedies. One rig of three still cameras, "
            "own materials. Published, on other objects: APE .081, D@100 .155, Acc 86.5 % at level 4.",
        ),
        *(table for recipe in TABLES.values() for table in recipe.pages),
        Table(
            "kills.json",
            "Commands that are killed at random moments",
            "command = command | killed = kills | whole before the second run = whole | torn = torn | "
            "second run failed = failed | ended otherwise than undisturbed = different",
            about="Twenty times each; the others had ended before.",
        ),
        Table(
            "data/verify.json",
            "Takes of all suites, verified",
            "check = key | worst = worst | limit = limit | unit = unit",
            rows="worst",
        ),
    ),
)

HISTORY = Page(
    "Results of earlier trackers",
    "These figures were not measured again with the tracker that ships; each names its commit. Written by "
    "`python benchmarks/update_pages.py`. The current figures are in [results.md](../results.md).",
    (
        tracking("validation.json", "Simulated validation objects", suite="standard"),
        discovery("validation.json", "Discovery on validation objects"),
        tracking(f"{APACHE}/test.json", "Weights trained on procedural objects only", suite="standard"),
        discovery(f"{APACHE}/test.json", "Discovery with these weights"),
        tracking("levels/test.json", "Levels 1 to 4 of the same objects"),
        tracking("robust/test.json", "Colour noise and a camera position that training never had"),
        alarms("monitor/blocks.json", "Alarms in the same streams, alpha for every 60 frames"),
        alarms(f"{APACHE}/monitor/test.json", "Alarms of the weights trained on procedural objects only"),
        intents("intents", "Open and lift: both rims of a closed laptop"),
        intents("ajar", "Both rims of a laptop, from where they are 16 pixels apart"),
        alarms("monitor/long.json", "Streams of 240 frames, alpha for the whole stream"),
        alarms("monitor/long_blocks.json", "Streams of 240 frames, alpha for every 60 frames"),
        Table(
            "scene_flow/test.json",
            "Scene flow: EPE3D",
            OBJECTS + "stride = stride | reading = reading | objects/takes/entities = objects/takes/entities | "
            "flow head = epe.head | zero flow = epe.zero | lifted points = epe.lifted",
        ),
        Table(
            "speed/training.json",
            "Training steps beside bare steps of the same network",
            "windows = batch | frames/s = frames_per_s | bare steps = bare_frames_per_s | "
            "share of bare % = %share_of_bare",
            rows="",
        ),
        Table(
            "endurance/endurance.json",
            "One stream of 100,000 frames",
            "frames = frames_done | memory at the end +% = memory_growth_percent.end | at most +% = "
            "memory_growth_percent.peak | early, ms = cpu_change.early_ms | late, ms = cpu_change.late_ms | "
            "change % = cpu_change.percent",
            rows="",
            about="Memory since frame 10,000 and processor time of a frame.",
        ),
    ),
)


PERFORMANCE = (
    Table(
        "speed/tracking.json",
        "Time of a frame on two processor cores",
        "engine = engine | queries = queries | frames = frames | median, ms = median_ms | "
        "95 % within, ms = p95_ms | frames/s = frames_per_s",
        about="640 x 480 pixels with depth, alarms on. No GPU was timed.",
    ),
    Table(
        "speed/tracking.json",
        "Time of the first frame with discovery",
        "engine = engine | times = n | median, ms = median_ms",
        rows="discovery",
    ),
    Table("speed/tracking.json", "Start", "what = what | times = n | median, s = median_s", rows="start"),
    Table(
        "speed/roofline.json",
        "Networks beside what the processor can do",
        "network = network | precision = precision | threads = threads | GFLOP = gflop | floor, ms = floor_ms | "
        "measured, ms = ms | times the floor = times",
        rows="networks",
        about="The floor is the network's operations over the rate of one product of 1024 x 1024 matrices in the "
        "same precision and with as many threads. The finder includes reading its maps off.",
    ),
    Table(
        "speed/roofline.json",
        "Parts of a frame",
        "part = part | ms = ms | OpenCV, SciPy, PyTorch, ms = compiled_ms | Python and NumPy, ms = rest_ms",
        rows="parts",
        about="Eight queries, one thread each; processor time. Descriptors are made meanwhile, on the other core.",
    ),
    Table(
        "speed/generation.json",
        "Making takes beside a bare SAPIEN loop",
        "takes = n_takes | frames = n_frames | frames/s = frames_per_s | bare loop = bare_frames_per_s | "
        "share of bare % = %share_of_bare",
        rows="",
        about="Three views of 224 × 224 pixels.",
    ),
)
"""Tables of the page of speed, whose text is written by hand."""


@dataclass(frozen=True)
class UpdatePages:
    """Rewrite the tables of README, cards and pages of results."""

    results: Path = ROOT / "benchmarks" / "results"
    check: bool = False
    """Change nothing; exit with 1 if a page is out of date."""

    def run(self) -> int:
        """Return 0, or 1 if --check finds a page out of date."""
        stale = 0
        for path, text in pages(self.results).items():
            if path.is_file() and path.read_text(encoding="utf-8") == text:
                continue
            if self.check:
                print(f"{path} is out of date: python benchmarks/update_pages.py", file=sys.stderr)
                stale = 1
            else:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(text, encoding="utf-8")
        return stale


def pages(folder: Path) -> dict[Path, str]:
    """Every page with figures, and the text that it should have."""
    written = {
        ROOT / "docs" / "results.md": whole(RESULTS, folder),
        ROOT / "docs" / "history" / "results.md": whole(HISTORY, folder),
    }
    speed = ROOT / "docs" / "performance.md"
    written[speed] = between_markers(speed.read_text(encoding="utf-8"), sections(PERFORMANCE, folder))
    for page in (ROOT / "README.md", *sorted(CARDS.glob("*.md"))):
        default = page.name == "README.md" or page.stem in DEFAULTS.values()
        text = page.read_text(encoding="utf-8")
        if default or BEGIN in text:  # a network that is there for comparison has no such table
            written[page] = between_markers(text, summary(folder, "" if default else page.stem))
    return written


def between_markers(text: str, table: str) -> str:
    """A page's text with another table between the markers."""
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    if not rest or END not in rest:
        raise SystemExit(f"expected the markers {BEGIN} and {END} in the page")
    return f"{before}{BEGIN}\n{table}\n{END}{after}"


def whole(page: Page, folder: Path) -> str:
    """A page as Markdown; tables whose report is missing or has no such rows are left out."""
    return f"# {page.title}\n\n{page.about}\n\n{sections(page.tables, folder)}\n"


def sections(tables: Iterable[Table], folder: Path) -> str:
    """Tables one below the other."""
    return "\n\n".join(section for table in tables if (section := as_section(table, folder)))


SUMMARY = ("measured on", "n", "measure", "QueST", "LK on a grid", "hold still")
RIVALS = {"lk-grid": "", "lk": " ¹"}
"""Trackers of the third column: the first that was measured, and its mark."""

REAL = (
    ("video.json", "real video, colours", "colours"),
    ("posed.json", "real RGB-D, camera poses given", "depth and poses"),
    ("posed.json", "real RGB-D, moving camera, no poses", "depth"),
    ("posed.json", "real rooms, moving camera, colours", "colours"),
    ("images.json", "real pictures", "colours"),
)
"""Result files of real recordings, what they are called, and what QueST is shown."""

REAL_MEASURES = (
    ("median error, px", "measures.median_px"),
    ("within 16 px, %", "%measures.within_16"),
    ("handles not found by itself, %", "!%measures.recall"),
)

SOURCES = {
    "partnet-mobility": "simulated, PartNet-Mobility",
    "procedural": "simulated, procedural",
    "sweethome3d": "simulated, free furniture",
}


def summary(folder: Path, weights: str = "") -> str:
    """The one table of README and cards.

    Args:
        folder: of all results.
        weights: name of the weights whose results lie in a folder of their own; empty for the default.
    """
    report = read_report(folder / weights / "test.json")
    if not report:
        return "No results yet."
    rows = [*([] if weights else real(folder / "real")), *simulated(report["rows"])]
    reports = [report, *(read_report(folder / "real" / file) for file, *_ in REAL if not weights)]
    old = any(old_tracker(each) for each in reports if each)
    seen = "224 × 224 pixels" if weights else "480 × 480 pixels, depth of a simulated stereo camera"
    text = ["**Measured with the tracker before the filter.**"] * old + [
        "In brackets: 95 % bootstrap intervals. n: clips / tracks or pictures / handles; simulated: objects / tracks. "
        f"Simulated objects were never trained on; level 1, {seen}; errors and identities are of entities that move.",
    ]
    if any("¹" in row for row in rows):
        text.append("¹ One point, not a grid.")
    text.append(f"Made by `python benchmarks/update_pages.py`; simulated: commit {report['run']['commit'][:9]}.")
    return "\n".join([line(SUMMARY), line("---" for _ in SUMMARY), *rows, "", *text])


def real(folder: Path) -> Iterable[str]:
    """Lines of the summary about real recordings."""
    for (file, place, inputs), of in product(REAL, ("tracks", "pictures")):
        rows = [row for row in read_report(folder / file).get("rows", []) if row["of"] == of]
        asked = {row["tracker"]: row for row in rows if row["tracker"] != "quest" or row["inputs"] == inputs}
        for measure, where in REAL_MEASURES:
            if "quest" in asked and cell(asked["quest"], where):
                yield summary_line(place, "units/targets", measure, where, asked)


def simulated(rows: list[dict[str, Any]]) -> Iterable[str]:
    """Lines of the summary about simulated test objects: points that were asked for, and what was found."""
    rows = [row for row in rows if row["level"] == 1 and row["suite"] == "standard"]
    for source, place in SOURCES.items():
        moved = {row["tracker"]: row for row in rows if row["source"] == source and matches(row, MOVED)}
        if not moved:
            continue
        for measure, where in (("median error, px", "metrics.median_px"), ("right identity, %", "%metrics.acc")):
            yield summary_line(place, "objects/tracks", measure, where, moved)
        own = {row["tracker"]: row for row in rows if row["source"] == source and matches(row, FOUND)}
        if own:
            yield summary_line(place, "objects/tracks", "not found by itself, %", "!%metrics.recall", own)


def summary_line(place: str, count: str, measure: str, where: str, rows: Mapping[str, Any]) -> str:
    """One line of the summary; a tracker without a row has an empty cell."""
    rival = next((name for name in RIVALS if name in rows), None)
    cells = [place, cell(rows["quest"], count), measure, cell(rows["quest"], where)]
    cells.append(cell(rows[rival], where) + RIVALS[rival] if rival else "")
    cells.append(cell(rows["hold-still"], where) if "hold-still" in rows else "")
    return line(cells)


def as_section(table: Table, folder: Path) -> str:
    """One table with its heading and notes; empty where there is nothing to show."""
    report = read_report(folder / table.file)
    return markdown(table, report, notes(report), before=old_tracker(report)) if report else ""


def old_tracker(report: Mapping[str, Any]) -> str:
    """What a table that the tracker before the filter gave says of that; empty for others."""
    commit = report.get("run", report)["commit"][:9]
    if commit not in BEFORE_FILTER:
        return ""
    return f"Measured with the tracker before the filter, commit {commit}{BEFORE_FILTER[commit]}."


def notes(report: Mapping[str, Any]) -> list[str]:
    """What made a table."""
    run = report.get("run", report)
    found = [f"`{run['command']}`, commit {run['commit'][:9]}."]
    if report.get("complete") is False:
        found.insert(0, "**Unfinished**: these are the takes so far.")
    if "machine" in report and "n_takes" in report:
        found.insert(0, f"{report['n_takes']} takes, {report['machine']}.")
    if making := report.get("making"):
        seeds, taught = ", ".join(map(str, making["seeds"])), counted(making["takes_per_object"], "take")
        found.append(
            f"Trainings: {making['steps']} steps of {making['batch']} windows on frozen features, {taught} per object "
            f"and level, seeds {seeds}, base: {making['base']}."
        )
    if "calibration" in report:
        found.append(f"Calibration: {report['calibration']}.")
    return found


def read_report(path: Path) -> dict[str, Any]:
    """A report; empty where there is no such file."""
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


if __name__ == "__main__":
    sys.exit(tyro.cli(UpdatePages).run())
