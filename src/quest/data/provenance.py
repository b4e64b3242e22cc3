"""What a number must carry to be made again: commit, data, machine, versions."""

from __future__ import annotations

import hashlib
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path

PACKAGES = ("quest-tracker", "torch", "numpy", "scipy", "opencv-python", "sapien", "trimesh")
_BUT_RESULTS = (":(top)", ":(top,exclude)benchmarks/results")


def code_commit() -> str:
    """Commit of the checkout that the package runs from, ``+dirty`` where tracked files differ; else the version.

    Results of benchmarks may differ: they are written one after the other, and no code reads them.
    """
    folder = Path(__file__).resolve().parent

    def git(*arguments: str) -> str:
        done = subprocess.run(["git", *arguments], cwd=folder, capture_output=True, text=True, check=True, timeout=10)
        return done.stdout.strip()

    try:
        commit = git("rev-parse", "HEAD")
        if git("ls-files", Path(__file__).name):  # an installed package may lie inside a checkout of something else
            changed = git("status", "--porcelain", "--untracked-files=no", "--", *_BUT_RESULTS)
            return commit + ("+dirty" if changed else "")
    except (OSError, subprocess.CalledProcessError, subprocess.TimeoutExpired):
        pass  # no git or no checkout: a released version says as much
    return f"version {metadata.version(PACKAGES[0])}"


def command_line() -> str:
    """The command of this process, in a shell's words, without ``--shard``.

    Shards share one result, which the last of them writes and the command without them makes as well.
    """
    words = iter(sys.argv[1:])
    kept = [word for word in words if not word.startswith("--shard=") and not (word == "--shard" and next(words, True))]
    return shlex.join(["quest", *kept])


def code_hash() -> str:
    """SHA-256 over the package's code and its object split; what was changed without a commit differs too."""
    folder = Path(__file__).resolve().parents[1]
    digest = hashlib.sha256()
    for path in sorted([*folder.rglob("*.py"), *folder.rglob("*.json")]):
        data = path.read_bytes()
        digest.update(f"{path.relative_to(folder).as_posix()}\0{len(data)}\n".encode() + data)
    return digest.hexdigest()


def combined_hash(hashes: Iterable[tuple[str, str]]) -> str:
    """One hash over the names and data hashes of takes, whatever their order."""
    digest = hashlib.sha256()
    for name, data_hash in sorted(hashes):
        digest.update(f"{name}\0{data_hash}\n".encode())
    return digest.hexdigest()


def file_hash(path: str | Path) -> str | None:
    """SHA-256 of a file; None if it is no file (a name of shipped weights)."""
    path = Path(path)
    if not path.is_file():
        return None
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def machine() -> str:
    """Operating system, processor and cores, without the host's name."""
    return f"{platform.system()} {platform.release()}, {platform.machine()}, {os.cpu_count()} cores"


def package_versions() -> dict[str, str]:
    """Versions of Python and the packages that compute; ``not installed`` where one is missing."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found
