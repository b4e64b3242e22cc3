"""``quest doctor``: the abilities of this machine, and the packages to install for the rest."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shutil
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from rich.markup import escape
from rich.table import Table

from quest.cli.console import Console
from quest.errors import QuestError
from quest.extras import MODULES_OF, explain_missing, install_command, is_installed
from quest.wording import counted

Status = Literal["ok", "optional", "broken"]

SIGNS: dict[Status, str] = {"ok": "[green]ok[/]", "optional": "[yellow]-[/]", "broken": "[bold red]NO[/]"}

MIN_FREE_GB = 1.0


@dataclass(frozen=True)
class Finding:
    """One line of the table."""

    part: str
    """The part of the machine or of the installation."""
    status: Status
    """``broken`` only if the base install cannot track without it."""
    found: str
    """The finding, in words."""
    remedy: str = ""
    """Advice, if there is any."""


@dataclass(frozen=True)
class Doctor:
    """Print what this machine can do: torch and devices, video, weights, renderer, optional parts."""

    render: bool = False
    """Render a few frames as well (takes up to half a minute without a GPU)."""
    json: bool = False
    """Print JSON instead: a list of parts, each with status, finding and remedy."""

    def run(self) -> int:
        """Print the table; 0 if a recorded clip can be tracked here, else 1."""
        rendering = (_renderer, _test_render) if self.render else (_renderer,)
        checks = (_python, _torch, _pictures, _video, _weights, *rendering, _objects, _extras, _disk)
        findings = [finding for check in checks for finding in check()]
        broken = [finding.part for finding in findings if finding.status == "broken"]
        if self.json:
            print(json.dumps([asdict(finding) for finding in findings], indent=1))
            return 1 if broken else 0
        title = "What this machine can do"
        table = Table("", "part", "found", title=title, title_justify="left", box=None, pad_edge=False)
        remedies = []
        for finding in findings:
            sign, part = SIGNS[finding.status], escape(finding.part)
            table.add_row(sign, part, escape(finding.found))
            if finding.remedy:
                remedies.append(f"\n{sign} {part}: {escape(finding.remedy)}")
        console = Console(markup=True, soft_wrap=False)
        console.print(table)
        for remedy in remedies:
            console.print(remedy, soft_wrap=True)
        console.print()
        if broken:
            console.print(f"[bold red]cannot track recordings here[/]: {', '.join(broken)}")
            return 1
        console.print("[green]ready to track recordings[/]")
        return 0


def _python() -> Iterator[Finding]:
    from quest import __version__

    yield Finding("quest", "ok", f"{__version__} at {Path(__file__).parents[1]}")
    yield Finding("python", "ok", f"{platform.python_version()} on {platform.system()} {platform.machine()}")


def _torch() -> Iterator[Finding]:
    try:
        import torch

        from quest.model.precision import fast_bfloat16
    except (ImportError, OSError) as error:
        yield Finding("torch", "broken", str(error), "pip install --constraint constraints.txt quest-tracker")
        return
    yield Finding("torch", "ok", f"{torch.__version__}, {torch.get_num_threads()} of {os.cpu_count()} threads")
    capability = torch.backends.cpu.get_cpu_capability()
    fast = "native" if fast_bfloat16(torch.device("cpu")) else "emulated"
    yield Finding("cpu", "ok", f"{platform.processor() or platform.machine()}, {capability}, bfloat16 {fast}")
    for index in range(torch.cuda.device_count()):
        properties = torch.cuda.get_device_properties(index)
        bf16 = "native" if fast_bfloat16(torch.device("cuda", index)) else "emulated"
        memory_gib = properties.total_memory / 2**30
        yield Finding(f"cuda:{index}", "ok", f"{properties.name}, {memory_gib:.0f} GiB, bfloat16 {bf16}")
    if torch.backends.mps.is_available():
        yield Finding("mps", "ok", "Apple GPU")
    elif not torch.cuda.is_available():
        yield Finding("gpu", "optional", "none that torch can use; everything runs on the CPU")


def _pictures() -> Iterator[Finding]:
    try:
        import cv2
    except ImportError as error:
        remedy = "on Debian and Ubuntu: apt-get install libgl1 libglib2.0-0 libxcb1"
        yield Finding("pictures", "broken", f"OpenCV cannot be imported: {error}", remedy)
    else:
        yield Finding("pictures", "ok", f"OpenCV {cv2.__version__}")


def _video() -> Iterator[Finding]:
    remedy = "pip install --force-reinstall av"
    try:
        import av

        av.Codec("h264", "r")
        encoder = av.Codec("libx264", "w").name
    except (ImportError, OSError) as error:
        yield Finding("video", "broken", f"PyAV cannot be imported: {error}", remedy)
    except ValueError:  # PyAV's error for an unknown codec
        yield Finding("video", "broken", f"PyAV {av.__version__} cannot read or write H.264", remedy)
    else:
        yield Finding("video", "ok", f"PyAV {av.__version__} with FFmpeg inside, H.264 by {encoder}")


def _weights() -> Iterator[Finding]:
    try:
        from quest.model.weights import shipped_weights
    except (ImportError, OSError):
        return  # torch is broken, which is reported already
    shipped = shipped_weights()
    for name, path in shipped.items():
        if name != path.stem:
            continue  # another name of one that comes later
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()[:12]
        yield Finding("weights", "ok", f"{name}, {path.stat().st_size / 1e6:.1f} MB, sha256 {digest}")
    if not shipped:
        yield Finding("weights", "broken", "none in the package", "reinstall quest-tracker, or train your own")


def _renderer() -> Iterator[Finding]:
    from quest.render_device import REMEDY, find_vulkan_icd

    try:
        driver = find_vulkan_icd()
    except QuestError as error:
        yield Finding("renderer", "optional", str(error))
        return
    if driver is None:
        yield Finding("renderer", "optional", "no Vulkan driver can render (needed to generate takes)", REMEDY)
    else:
        yield Finding("renderer", "ok", f"{driver}{'' if driver.on_gpu is not False else ', on the CPU'}")


def _test_render() -> Iterator[Finding]:
    start_s = time.monotonic()
    try:
        from quest.sim.generate import TakeSettings, generate_take
        from quest.sim.procedural import CATEGORIES, make_object
        from quest.sim.renderer import Renderer

        settings = TakeSettings(views=1, size=64, every=8)
        take = generate_take(make_object(CATEGORIES[0], 0), 1, 0, renderer=Renderer(), settings=settings)
    except (QuestError, ModuleNotFoundError) as error:
        missing = explain_missing(error) if isinstance(error, ModuleNotFoundError) else None
        yield Finding("render test", "optional", str(missing or error))
        return
    seconds = time.monotonic() - start_s
    contrast = int(take.views[0].clip.rgb.std())
    yield Finding(
        "render test", "ok", f"{counted(len(take), 'frame')} in {seconds:.0f} s with shaders, contrast {contrast}"
    )


def _objects() -> Iterator[Finding]:
    named = os.environ.get("QUEST_OBJECTS", "")
    if not named:
        yield Finding("objects", "optional", "QUEST_OBJECTS is not set", "name a folder of PartNet-Mobility objects")
        return
    count = sum(1 for _ in Path(named).glob("*/mobility.urdf"))
    if count:
        yield Finding("objects", "ok", f"{counted(count, 'object folder')} in {named}")
    else:
        yield Finding("objects", "optional", f"no object folder in {named}", "correct QUEST_OBJECTS, or unset it")


def _extras() -> Iterator[Finding]:
    for extra, modules in MODULES_OF.items():
        missing = [module for module in modules if not is_installed(module)]
        if missing:
            yield Finding(f"[{extra}]", "optional", f"missing: {', '.join(missing)}", install_command(extra))
        else:
            yield Finding(f"[{extra}]", "ok", "installed")


def _disk() -> Iterator[Finding]:
    free_gb = shutil.disk_usage(Path.cwd()).free / 1e9
    few = free_gb < MIN_FREE_GB
    yield Finding("disk", "optional" if few else "ok", f"{free_gb:.0f} GB free here", "make room" if few else "")
