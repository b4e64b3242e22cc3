"""What is given to others: the wheel, its content and an environment of its own, the workflows."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest
import yaml

from quest.cli.main import main
from quest.cli.track import Track

pytestmark = [pytest.mark.plain, pytest.mark.xdist_group("built")]

ROOT = Path(__file__).parents[1]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


def test_the_demo_tracks_both_clips(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    ran = []
    monkeypatch.setattr(Track, "run", lambda self: ran.append((self.clip, self.out)))
    assert main(["demo", "--out", str(tmp_path / "demo")]) == 0
    assert ran == [("sample", tmp_path / "demo"), ("sample-alarm", tmp_path / "demo-alarm")]
    said = capsys.readouterr().out
    assert str(tmp_path / "demo" / "overlay.mp4") in said
    assert str(tmp_path / "demo-alarm" / "overlay.mp4") in said


@pytest.mark.parametrize("workflow", ["ci.yml", "release.yml", "weekly.yml"])
def test_workflows_are_well_formed_and_name_what_exists(workflow: str):
    assert workflow in {path.name for path in WORKFLOWS}
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    read = yaml.safe_load((ROOT / ".github" / "workflows" / workflow).read_text(encoding="utf-8"))
    assert read[True], "YAML reads the key `on` as true"
    assert read["permissions"] == {"contents": "read"}
    for job in read["jobs"].values():
        assert job["timeout-minutes"] if "environment" not in job else True
        assert {job["needs"]} <= set(read["jobs"]) if "needs" in job else True
        for step in job["steps"]:
            assert ("uses" in step) != ("run" in step)
            if "uses" in step:
                assert re.fullmatch(r"[\w-]+/[\w-]+@(v\d+|release/v\d+)", step["uses"]), "pinned to a major version"
            targets = re.findall(r"\bmake ([a-z-]+)", step.get("run", ""))
            if "make ${{ matrix.what }}" in step.get("run", ""):
                targets += job["strategy"]["matrix"]["what"]
            for target in targets:
                assert re.search(rf"^{target}:", makefile, re.MULTILINE), target
            for file in re.findall(r"\b[\w./-]+\.(?:txt|py)\b", step.get("run", "") + str(step.get("with", ""))):
                assert (ROOT / file).is_file(), file


def test_the_release_tries_all_platforms_and_publishes_without_secrets():
    text = (ROOT / ".github" / "workflows" / "release.yml").read_text(encoding="utf-8")
    jobs = yaml.safe_load(text)["jobs"]
    matrix = jobs["try"]["strategy"]["matrix"]
    assert [name.partition("-")[0] for name in matrix["os"]] == ["ubuntu", "macos", "windows"]
    assert matrix["python"] == ["3.11", "3.13"]
    assert 'quest" demo' in text
    assert jobs["publish"]["permissions"] == {"id-token": "write"}
    assert jobs["publish"]["if"] == "github.ref_type == 'tag'"
    assert "secrets." not in text
    tag = r'grep -qx "__version__ = \"'
    assert tag in text
    assert re.search(r'^__version__ = "[\d.]+"$', (ROOT / "src/quest/__init__.py").read_text(), re.MULTILINE)


WEIGHTS = sorted((ROOT / "src" / "quest" / "assets" / "weights").glob("*.safetensors"))


def weights_of(package: Path) -> list[Path]:
    return [package / path.relative_to(ROOT / "src" / "quest") for path in WEIGHTS]


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the project, with the wheel and the source distribution in its ``dist``, built without a network.

    Weights are empty files in it: to compress them takes longer than all else, and does not make them smaller.
    """
    source = tmp_path_factory.mktemp("source")
    left_out = shutil.ignore_patterns("__pycache__", *(path.name for path in WEIGHTS))
    shutil.copytree(ROOT / "src" / "quest", source / "src" / "quest", ignore=left_out)
    for path in weights_of(source / "src" / "quest"):
        path.touch()
    for path in (*ROOT.glob("*.md"), *map(ROOT.joinpath, ("pyproject.toml", "LICENSE", "NOTICE", "MANIFEST.in"))):
        shutil.copy(path, source)
    (source / "tests").mkdir()
    shutil.copy(Path(__file__), source / "tests")
    build = "from setuptools.build_meta import *; build_sdist('dist'); build_wheel('dist')"
    run = subprocess.run([sys.executable, "-c", build], cwd=source, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout[-2000:] + run.stderr[-2000:]
    return source


@pytest.mark.slow
def test_the_wheel_holds_the_package_and_nothing_else(built: Path):
    (wheel,) = built.glob("dist/*.whl")
    held = set(zipfile.ZipFile(wheel).namelist())
    package = built / "src" / "quest"
    kept = [path for path in package.rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    assert {f"quest/{path.relative_to(package).as_posix()}" for path in kept} == {n for n in held if n[:6] == "quest/"}
    about = {name.partition("/")[2] for name in held if not name.startswith("quest/")}
    assert about >= {"METADATA", "RECORD", "entry_points.txt", "licenses/LICENSE", "licenses/NOTICE"}
    assert all(name.partition("/")[0].endswith(".dist-info") for name in held if not name.startswith("quest/"))
    assert {"quest/py.typed", "quest/assets/monitor.json", "quest/assets/sample/camera.json"} <= held
    whole_bytes = wheel.stat().st_size + sum(path.stat().st_size for path in WEIGHTS)
    assert whole_bytes < 100e6, "PyPI takes no more than 100 MB"


@pytest.mark.slow
def test_the_source_distribution_holds_the_package_alone(built: Path):
    (sdist,) = built.glob("dist/*.tar.gz")
    with tarfile.open(sdist) as archive:
        held = {name.partition("/")[2] for name in archive.getnames()}
    assert {"pyproject.toml", "LICENSE", "NOTICE", "src/quest/py.typed"} <= held
    assert {name.partition("/")[0] for name in held if "/" in name} <= {"src"}


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_wheel_works_in_an_environment_of_its_own(built: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Only the dependencies are those that are installed here, and weights are put where their empty files are."""
    monkeypatch.delenv("PYTHONPATH", raising=False)
    (wheel,) = built.glob("dist/*.whl")
    venv.create(tmp_path / "env", symlinks=True)
    bin_folder = Path(sysconfig.get_path("scripts", "venv", {"base": str(tmp_path / "env")}))
    python = next(bin_folder.glob("python*"))
    pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet"]
    subprocess.run([*pip, "--no-deps", "--no-index", "--no-compile", str(wheel)], check=True)
    where = "import importlib.util; print(importlib.util.find_spec('quest').origin)"
    here = subprocess.run([python, "-c", where], capture_output=True, text=True, check=True)
    package = Path(here.stdout.strip()).parent
    assert package.is_relative_to(tmp_path)
    for empty, whole in zip(weights_of(package), WEIGHTS, strict=True):
        assert empty.stat().st_size == 0
        empty.unlink()
        empty.symlink_to(whole)
    (package.parent / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    (tmp_path / "elsewhere").mkdir()
    quest = next(bin_folder.glob("quest*"))
    command = [quest, "find", "sample-alarm", "--out", "found"]  # clip, weights and networks; the release runs the demo
    ran = subprocess.run(command, cwd=tmp_path / "elsewhere", capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert {path.name for path in (tmp_path / "elsewhere" / "found").iterdir()} == {"found.png", "found.json"}
    assert "knob" in ran.stdout
