"""Write the tables of docs/licences.md and docs/weights.md: of the packages and weights that are installed here.

python -m benchmarks.package_tables            # in an environment with all extras
python -m benchmarks.package_tables --check    # fail if a page would change
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path

import tyro
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from benchmarks.update_pages import cell, line, matches, read_report
from quest.extras import DISTRIBUTION
from quest.model.tensor_file import read_tensors
from quest.model.weights import shipped_weights

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
NOT_RUNTIME = ("dev", "docs")
"""Extras for work on the project itself."""

PURPOSE = {
    "quest-s16-apache": "finding handles, knobs, rims, fronts, hinges, doors and drawers",
    "quest-paper": "comparison with the published network",
}


def requirements(distribution: str, extra: str = "") -> Iterator[Requirement]:
    """What a distribution asks for, on this machine, with one of its extras or without."""
    for text in metadata.requires(distribution) or []:
        required = Requirement(text)
        wanted = required.marker is None or required.marker.evaluate({"extra": extra})
        if wanted and (not extra or "extra" in str(required.marker)):
            yield required


def closure(required: Iterable[Requirement]) -> set[str]:
    """Names of these and of all that they bring along; what is not installed here is left out."""
    found: set[str] = set()
    waiting = [(requirement.name, extra) for requirement in required for extra in ("", *requirement.extras)]
    asked: set[tuple[str, str]] = set()
    while waiting:
        name, extra = waiting.pop()
        if (name, extra) in asked or version(name) is None:
            continue
        asked.add((name, extra))
        found.add(canonicalize_name(name))
        waiting += [(inner.name, more) for inner in requirements(name, extra) for more in ("", *inner.extras)]
    return found


@cache
def version(name: str) -> str | None:
    """Version of a distribution; None if it is not installed."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def licence(name: str) -> str:
    """Licence of a distribution as its metadata state it: the expression, else the classifiers, else the first line."""
    about = metadata.metadata(name)
    classifiers = [c.rpartition(" :: ")[2] for c in about.get_all("Classifier") or [] if c.startswith("License ::")]
    stated = [*(about.get_all("License-Expression") or []), ", ".join(classifiers), *(about.get_all("License") or [])]
    return next((text.strip().splitlines()[0] for text in stated if text.strip()), "not stated")


def dependencies(extras: bool) -> str:
    """Table of the packages of the base install, or of what the extras add to it."""
    base = closure(requirements(DISTRIBUTION))
    reasons: dict[str, list[str]] = {}
    if extras:
        for extra in metadata.metadata(DISTRIBUTION).get_all("Provides-Extra") or []:
            brought = set() if extra in NOT_RUNTIME else closure(requirements(DISTRIBUTION, extra)) - base
            for name in brought:
                reasons.setdefault(name, []).append(f"`{extra}`")
    else:
        direct = {canonicalize_name(requirement.name) for requirement in requirements(DISTRIBUTION)}
        reasons = {name: ["quest" if name in direct else "others"] for name in base}
    rows = [
        line((name, version(name) or "", licence(name), ", ".join(why)))
        for name, why in sorted(reasons.items())
        if name != DISTRIBUTION
    ]
    return "\n".join([line(("package", "version", "licence by its metadata", "needed by")), line(["---"] * 4), *rows])


def ffmpeg_libraries() -> str:
    """Table of the FFmpeg inside the wheels of PyAV and OpenCV: what the libraries say of themselves."""
    rows = []
    for name, folder in (("av", "av.libs"), ("opencv-python", "opencv_python.libs")):
        libraries = sorted(Path(str(metadata.distribution(name).locate_file(folder))).glob("*.so*"))
        avutil = next((path for path in libraries if path.name.startswith("libavutil")), None)
        if avutil is None:
            rows.append(line((f"{name} {version(name)}", "not found", "", "", "")))
            continue
        loaded = ctypes.CDLL(str(avutil))
        loaded.avutil_license.restype = loaded.avutil_configuration.restype = ctypes.c_char_p
        flags = loaded.avutil_configuration().decode().split()
        terms = [f"`{term}`" for term in ("enable-gpl", "enable-nonfree", "enable-version3") if f"--{term}" in flags]
        beside = [each for each in ("libx264", "libx265") if any(path.name.startswith(each) for path in libraries)]
        said = loaded.avutil_license().decode()
        rows.append(line((f"{name} {version(name)}", said, ", ".join(terms), ", ".join(beside) or "none")))
    heads = (
        "wheel",
        "licence that libavutil states",
        "of gpl, nonfree, version3 its configuration has",
        "GPL encoders",
    )
    return "\n".join([line(heads), line(["---"] * 4), *rows])


def weights() -> str:
    """Table of the weights that ship."""
    heads = ("name", "MB", "licence", "for", "score", "on two processor cores")
    rows = []
    for name, path in shipped_weights().items():
        if name == path.stem:
            stated = read_tensors(path, ())[0].get("licence") or "not stated"
            size = f"{path.stat().st_size / 1e6:.1f}"
            rows.append(line((f"`{name}`", size, stated, PURPOSE[name], scores(name), speed(name))))
    return "\n".join([line(heads), line(["---"] * len(heads)), *rows])


def scores(name: str) -> str:
    """The one or two figures that say most, out of the result files."""
    if name == "quest-paper":
        asked = {"tracker": "quest", "reading": "moved", "source": "partnet-mobility", "level": 4}
        row = next(row for row in read_report(RESULTS / "published.json")["rows"] if matches(row, asked))
        return f"new motions of the objects that taught, level 4: right identity {cell(row, '%metrics.acc')} %"
    asked = {"tracker": "quest", "of": "pictures"}
    row = next(row for row in read_report(RESULTS / "real" / "images.json")["rows"] if matches(row, asked))
    missed, right = cell(row, "!%measures.recall"), cell(row, "%measures.precision")
    return f"real pictures: {missed} % of handles not found, {right} % of answers right"


def speed(name: str) -> str:
    """How long they take, out of the result file of the tracker's speed."""
    if name == "quest-paper":
        return "not measured"
    found = read_report(RESULTS / "speed" / "tracking.json")
    own = {"engine": "torch", "queries": 8}
    frame_ms = next(row for row in found["rows"] if matches(row, own))["median_ms"]
    look_ms = next(row for row in found["discovery"] if row["engine"] == "torch")["median_ms"]
    return f"{look_ms:.0f} ms a look, {frame_ms:.0f} ms a frame of 640 × 480 with 8 queries"


def written() -> dict[Path, str]:
    """Both pages with the tables that they should have."""
    tables = {
        ROOT / "docs" / "licences.md": {
            "base": dependencies(extras=False),
            "extras": dependencies(extras=True),
            "ffmpeg": ffmpeg_libraries(),
        },
        ROOT / "docs" / "weights.md": {"weights": weights()},
    }
    pages = {}
    for path, of_page in tables.items():
        text = path.read_text(encoding="utf-8")
        for name, table in of_page.items():
            before, begin, rest = text.partition(f"<!-- {name}:begin -->")
            _, end, after = rest.partition(f"<!-- {name}:end -->")
            if not begin or not end:
                raise SystemExit(f"{path}: expected the markers <!-- {name}:begin --> and <!-- {name}:end -->")
            text = f"{before}{begin}\n{table}\n{end}{after}"
        pages[path] = text
    return pages


@dataclass(frozen=True)
class PackageTables:
    """Rewrite the tables, or check them."""

    check: bool = False
    """Change nothing; exit with 1 if a page is out of date."""

    def run(self) -> int:
        """Return 0, or 1 if --check finds a page out of date."""
        stale = {path: text for path, text in written().items() if path.read_text(encoding="utf-8") != text}
        for path, text in stale.items():
            if self.check:
                print(f"{path} is out of date: python -m benchmarks.package_tables", file=sys.stderr)
            else:
                path.write_text(text, encoding="utf-8")
        return 1 if self.check and stale else 0


if __name__ == "__main__":
    sys.exit(tyro.cli(PackageTables).run())
