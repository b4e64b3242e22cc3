"""README and docs are run as written: Python blocks, commands (all are parsed, most are run).

They run in a folder that has what the pages speak of, tiny; the packaged clip has its first frames only.
"""

from __future__ import annotations

import re
import shlex
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.synthetic import make_take
from tests.tiny import make_finder
from tests.track.clips import make_calibration

if TYPE_CHECKING:  # the hook of the shape checks comes first
    from quest.model.weights import LoadedNetwork

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
PAGES = [README, *sorted(ROOT.glob("C*.md")), *sorted((ROOT / "docs").rglob("*.md"))]

RUN = ("track", "monitor", "doctor", "weights list", "weights show", "data")
"""Commands that are run, beside being parsed; the others render, train or evaluate, and have tests of their own."""

NOT_RUN = {
    "owner/name": "asks the hub; tests/model/test_hub.py has one",
    "--rerun": "opens a window",
    "s3://": "asks an object store; tests/data/test_object_store.py has one",
    "exported": "exports for minutes; tests/cli/test_export.py",
    "--engine onnx": "the same",
    "Renderer()": "renders for a minute; tests/sim/test_generate.py",
}
"""What stands in a command or a block that is not run, and why."""

FRAMES = 8


def blocks(path: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", path.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


def commands() -> list[tuple[str, str]]:
    """Page and line of every `quest ...` command that the pages show in a block."""
    found = []
    for page in PAGES:
        lines = [line for block in blocks(page, "sh") for line in block.splitlines()]
        lines += re.findall(r"^    (quest .*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
        found += [(page.name, line.strip()) for line in lines if line.startswith("quest ")]
    return found


@pytest.mark.parametrize(("page", "command"), commands())
def test_commands_parse(page, command):
    from quest.cli.main import parse

    parse(shlex.split(command, comments=True)[1:])


def test_there_are_commands_to_check():
    assert {page for page, _ in commands()} >= {"README.md", "takes.md"}


def test_make_targets_exist():
    makefile = (ROOT / "Makefile").read_text()
    text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    assert {"demo", "test"} <= set(re.findall(r"\bmake ([a-z-]+)\b", text))
    for target in set(re.findall(r"(?:`|^)make ([a-z-]+)", text, re.MULTILINE)):
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target


def test_links_lead_somewhere():
    dead = [
        f"{page.name}: {link}"
        for page in PAGES
        for link in re.findall(r"\]\(([^)#:]+)\)", page.read_text(encoding="utf-8"))
        if not (page.parent / link).exists()
    ]
    assert not dead


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the pages speak of."""
    import quest
    from quest.data.lerobot_export import Episode, export_lerobot
    from quest.data.mcap_export import export_mcap
    from quest.data.queries_file import write_queries
    from quest.data.recording import write_recording
    from quest.data.store import TakeStore
    from quest.model.weights import save_network

    folder = tmp_path_factory.mktemp("pages")
    whole = quest.read("sample")
    assert whole.depth_m is not None
    rows = slice(FRAMES)
    clip = replace(
        whole,
        rgb=whole.rgb[rows],
        depth_m=whole.depth_m[rows],
        stamp_s=whole.stamp_s[rows],
        cam_from_world=whole.cam_from_world[rows],
    )
    for name in ("sample", "path/to/recording", "left", "middle", "right"):
        write_recording(clip, folder / name)
    for name in ("drawer.mcap", "drive.mcap"):
        export_mcap(clip, folder / name)
    export_lerobot([Episode({"front": clip}, "open a drawer")] * 4, folder / "datasets/drawers")
    shutil.copy(folder / "sample" / "camera.json", folder / "front.json")
    for store in ("takes/try", "takes/mine"):
        take = make_take(frames=FRAMES, views=1, entities=2, name="44817-L1-s000000")
        TakeStore(folder / store).write(take)
    TakeStore(folder / "STORE").write(make_take(frames=FRAMES, views=3, entities=2, name="NAME"))
    for run in ("runs/found", "runs/mine"):
        (folder / run).mkdir(parents=True)
        save_network(folder / run / "weights.safetensors", make_finder(), settings="{}", about="tiny")
    shutil.copy(folder / "sample" / "rgb.mp4", folder / "my.mp4")
    tracks = quest.load().track(clip, [quest.Query.semantic("handle")])
    for run in ("outputs/demo", "outputs/alarm"):
        tracks.save(folder / run)
    write_queries([quest.Query.point(1, 100, 80, name="picked")], folder / "queries.json")
    return folder


@pytest.fixture(scope="module")
def read_once() -> Callable[[str], LoadedNetwork]:
    """Reads weights as the tracker does, those that ship once for all pages."""
    from quest.model.weights import load_network, shipped_weights

    shipped = cache(load_network)
    return lambda name: shipped(name) if name in shipped_weights() else load_network(name)


@pytest.fixture
def there(made: Path, read_once: Callable[[str], LoadedNetwork], monkeypatch: pytest.MonkeyPatch) -> Path:
    """That folder, as the one where one is, and with the clip that is packaged."""
    monkeypatch.chdir(made)
    monkeypatch.setattr("quest.track.tracker.load_network", read_once)
    monkeypatch.setattr("quest.data.sample.sample_folder", lambda *name: made / "sample")
    return made


def why_not(text: str) -> str | None:
    """Why a command or a block is not run."""
    return next((reason for words, reason in NOT_RUN.items() if words in text), None)


def runnable() -> list[str]:
    """Commands of all pages that are run, each once."""
    found = {shlex.join(shlex.split(command, comments=True)) for _, command in commands()}
    return sorted(c for c in found if c.removeprefix("quest ").startswith(RUN) and not why_not(c))


@pytest.mark.slow
@pytest.mark.parametrize("command", runnable())
def test_commands_run(command: str, there: Path):
    from quest.cli.main import main

    assert main(shlex.split(command)[1:]) == 0


def namespace(folder: Path) -> dict[str, object]:
    """What the pages take for granted in their Python blocks."""
    import quest

    clip = quest.read(folder / "sample")
    tracker, queries = quest.load(), [quest.Query.semantic("handle")]
    frame = clip.frame(0)
    return {
        "quest": quest,
        "clip": clip,
        "camera": clip.camera,
        "frames": [clip.frame(t) for t in range(len(clip))],
        "rgb": frame.rgb,
        "depth_m": frame.depth_m,
        "stamp_s": frame.stamp_s,
        "tracker": tracker,
        "queries": queries,
        "text": make_calibration(alarming=False).to_json(),
    }


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "python")], ids=lambda page: page.name)
def test_python_blocks_run(page: Path, there: Path):
    """One after the other, as a reader would paste them."""
    shared = namespace(there)
    for block in blocks(page, "python"):
        if not why_not(block):
            exec(compile(block, f"<{page.name}>", "exec"), shared)


def test_every_reason_not_to_run_something_is_needed():
    shown = [command for _, command in commands()] + [block for page in PAGES for block in blocks(page, "python")]
    assert not [words for words in NOT_RUN if not any(words in text for text in shown)]
