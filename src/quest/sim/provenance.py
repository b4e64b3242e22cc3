"""What made a take: commit, versions and renderer, for its metadata."""

from __future__ import annotations

import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

_PACKAGES = ("quest-tracker", "sapien", "numpy", "trimesh")


def take_provenance(*, renderer: str, command: str) -> dict[str, Any]:
    """Metadata of the takes of one run.

    Args:
        renderer: device that renders.
        command: command line that was called.
    """
    return {
        "commit": _commit(),
        "versions": {p: _version(p) for p in _PACKAGES},
        "renderer": renderer,
        "command": command,
    }


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _commit() -> str | None:
    """Commit of the checkout that this package runs from, with ``+`` if it was changed; None if it is installed."""
    folder = Path(__file__).parent
    git = ["git", "-C", str(folder)]
    try:
        commit = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True, check=True).stdout.strip()
        changed = subprocess.run(
            [*git, "status", "--porcelain", "--", str(folder)], capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return commit + ("+" if changed.stdout.strip() else "")
