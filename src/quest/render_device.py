"""Finding a Vulkan driver that can render, without importing SAPIEN.

Vulkan drivers announce themselves by small JSON files (an *installable client driver*, ICD). This
module picks the one that SAPIEN can use and puts it into the environment before SAPIEN is imported:
the user's own choice, else an NVIDIA driver where a GPU is present, else SwiftShader, the software
renderer that ships with Chromium and Chrome, else a recent enough lavapipe.
"""

from __future__ import annotations

import json
import os
import re
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from quest.errors import RendererError

ICD_VARIABLES = ("VK_DRIVER_FILES", "VK_ICD_FILENAMES")
"""Variables by which the Vulkan loader is told what to load; the first one wins."""

ICD_FOLDERS = (
    "etc/vulkan/icd.d",
    "usr/share/vulkan/icd.d",
    "usr/local/share/vulkan/icd.d",
    "usr/local/etc/vulkan/icd.d",
)

SWIFTSHADER_PLACES = (
    "usr/lib/chromium/vk_swiftshader_icd.json",
    "usr/lib64/chromium-browser/vk_swiftshader_icd.json",
    "usr/lib/chromium-browser/vk_swiftshader_icd.json",
    "opt/google/chrome/vk_swiftshader_icd.json",
    "opt/microsoft/msedge/vk_swiftshader_icd.json",
    "opt/brave.com/brave/vk_swiftshader_icd.json",
    "snap/chromium/current/usr/lib/chromium-browser/vk_swiftshader_icd.json",
)

LIBRARY_FOLDERS = (
    "usr/lib/x86_64-linux-gnu",
    "usr/lib/aarch64-linux-gnu",
    "usr/lib64",
    "usr/lib",
    "usr/local/nvidia/lib64",
    "usr/lib/wsl/lib",
)

LAVAPIPE_MIN_HEADER = 302
"""Vulkan header revision of Mesa 24.3, the first whose lavapipe has the external handles that SAPIEN asks for."""

REMEDY = (
    "install a software renderer with `make render-deps` (Debian: `apt-get install chromium libvulkan1`; "
    "elsewhere: Chromium that is no snap, or Google Chrome), or install the NVIDIA driver with its graphics "
    "libraries, or name a driver yourself with VK_ICD_FILENAMES=/path/to/icd.json"
)

_KNOWN_WARNING = re.compile(rb"swiftshader/src/\S+ WARNING: UNSUPPORTED: ")

DriverKind = Literal["chosen", "nvidia", "swiftshader", "lavapipe", "system"]


@dataclass(frozen=True)
class VulkanDriver:
    """A Vulkan driver that can render."""

    kind: DriverKind
    """``chosen`` by the user's environment, ``nvidia``, ``swiftshader``, ``lavapipe``, or ``system`` where the platform
    brings its own (macOS, Windows)."""
    icd: str | None
    """The driver's JSON file, or the list of files that the user chose; None where the loader finds it by itself."""

    @property
    def on_gpu(self) -> bool | None:
        """Whether it renders on a GPU; None if that cannot be told from the files."""
        return {"nvidia": True, "swiftshader": False, "lavapipe": False}.get(self.kind)

    def __str__(self) -> str:
        return self.kind if self.icd is None else f"{self.kind} ({self.icd})"


def find_vulkan_icd(*, environ: Mapping[str, str] | None = None, root: Path = Path("/")) -> VulkanDriver | None:
    """The Vulkan driver that rendering should use; None if there is none that is known to work.

    Variables are those of the process by default; the file system starts at the root.

    Raises:
        RendererError: the user's environment names drivers that do not exist.
    """
    environ = os.environ if environ is None else environ
    for variable in ICD_VARIABLES:
        named = environ.get(variable, "")
        missing = [name for name in named.split(os.pathsep) if name and not Path(name).exists()]
        if missing:
            raise RendererError(
                f"{variable} names {', '.join(missing)}, which does not exist; "
                f"unset {variable} to let quest search, or correct it"
            )
        if named:
            return VulkanDriver("chosen", named)
    if not sys.platform.startswith("linux"):
        return VulkanDriver("system", None)
    return _find_nvidia(root) or _find_swiftshader(root) or _find_lavapipe(root)


def prepare_renderer() -> VulkanDriver:
    """Choose the Vulkan driver that SAPIEN will load in this process; call it before SAPIEN is imported.

    Raises:
        RendererError: no driver is known to work; the message says what to install.
    """
    driver = find_vulkan_icd()
    if driver is None:
        raise RendererError(f"no Vulkan driver here can render (looked for NVIDIA's, SwiftShader, lavapipe): {REMEDY}")
    if driver.kind != "chosen" and driver.icd is not None:
        # The older name of the variable is understood by every loader, SAPIEN's own included.
        os.environ["VK_ICD_FILENAMES"] = driver.icd
    return driver


@contextmanager
def without_known_warnings() -> Iterator[None]:
    """Keep SwiftShader's remarks on unsupported properties off standard error; other lines come at the end.

    They are written by native code, which knows no ``sys.stderr``, when a renderer first looks at its devices.
    """
    sys.stderr.flush()
    with tempfile.TemporaryFile() as kept:
        try:
            original = os.dup(2)
        except OSError:  # standard error is closed
            yield
            return
        os.dup2(kept.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(original, 2)
            os.close(original)
            kept.seek(0)
            for line in kept:
                if not _KNOWN_WARNING.search(line):
                    os.write(2, line)


def _find_nvidia(root: Path) -> VulkanDriver | None:
    # A container may show the device without the driver's graphics libraries; Vulkan then finds nothing.
    device = (root / "dev/nvidia0").exists() or (root / "dev/nvidiactl").exists()
    library = any((root / folder / "libGLX_nvidia.so.0").exists() for folder in LIBRARY_FOLDERS)
    if not (device and library):
        return None
    icd = _first_icd(root, "nvidia_icd*.json")
    # Without a file of the driver's own, SAPIEN brings one.
    return VulkanDriver("nvidia", None if icd is None else str(icd))


def _find_swiftshader(root: Path) -> VulkanDriver | None:
    icd = next((root / place for place in SWIFTSHADER_PLACES if (root / place).is_file()), None)
    return None if icd is None else VulkanDriver("swiftshader", str(icd))


def _find_lavapipe(root: Path) -> VulkanDriver | None:
    icd = _first_icd(root, "lvp_icd*.json")
    if icd is None:
        return None
    try:
        header = int(str(json.loads(icd.read_text())["ICD"]["api_version"]).split(".")[2])
    except (OSError, ValueError, KeyError, IndexError, TypeError):
        return None  # an unreadable announcement is as good as none
    return VulkanDriver("lavapipe", str(icd)) if header >= LAVAPIPE_MIN_HEADER else None


def _first_icd(root: Path, pattern: str) -> Path | None:
    return next((icd for folder in ICD_FOLDERS for icd in sorted((root / folder).glob(pattern))), None)
