"""Where takes lie: a folder of the file system, or a prefix of an object store (:mod:`quest.data.object_store`).

A location knows nothing of arrays. It lists takes, reads their headers, and receives the files of a new take as a draft
that becomes a take all at once or not at all.
"""

from __future__ import annotations

import os
import shutil
import socket
import time
import uuid
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from quest.data.take_format import HEADER_FILE
from quest.errors import TakeError

if TYPE_CHECKING:
    from zarr.storage import StoreLike

SUFFIX = ".zarr"

_TEMPORARY = ".tmp-"
_ABANDONED_AFTER_S = 24 * 3600.0
_SYNCS_AT_ONCE = 16


class StoreError(TakeError):
    """A place for takes that cannot be reached: this says nothing about any take."""


@runtime_checkable
class Draft(Protocol):
    """A take that is being written; nobody sees it before :meth:`commit`."""

    arrays_at: str
    """Subgroup that the arrays go to; empty for the group itself."""

    def add(self, path: str, data: bytes | memoryview) -> None:
        """Write a file; ``path`` is relative to the take."""
        ...

    def commit(self, header: bytes) -> None:
        """Write the header, which makes the draft a take.

        Raises:
            TakeError: the take was written by somebody else meanwhile.
        """
        ...


@runtime_checkable
class Location(Protocol):
    """A place for takes."""

    url: str
    """What the user called it."""
    parallel: int
    """How many headers are best read at the same time."""

    def exists(self) -> bool:
        """Whether anything is there."""
        ...

    def names(self) -> list[str]:
        """Names of everything that looks like a take, whole or not, sorted."""
        ...

    def describe(self, name: str) -> str:
        """Path or URL of a take, for messages."""
        ...

    def is_there(self, name: str) -> bool:
        """Whether anything of a take is there, whole or not."""
        ...

    def may_write(self, name: str) -> bool:
        """Whether a take of that name may be written."""
        ...

    def header(self, name: str) -> bytes | None:
        """Content of a take's header; None if it has none."""
        ...

    def sizes(self, name: str, files: Mapping[str, int]) -> dict[str, int]:
        """Sizes in bytes of those files that are there, by path relative to the take."""
        ...

    def zarr_group(self, name: str, arrays_at: str) -> tuple[StoreLike, str]:
        """Zarr store and path in it of the group that holds a take's arrays."""
        ...

    def draft(self, name: str) -> AbstractContextManager[Draft]:
        """A new take; what was not committed at the end is removed."""
        ...

    def reaching(self) -> AbstractContextManager[None]:
        """Turns what goes wrong between here and there into a StoreError."""
        ...


class LocalFolder:
    """Takes in a folder: each is made in a hidden folder beside the others, and a rename makes it a take."""

    parallel = 1

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.url = str(folder)

    def path(self, name: str) -> Path:
        """Folder of a take, there or not."""
        return self.folder / f"{name}{SUFFIX}"

    def exists(self) -> bool:
        """Whether the folder exists."""
        return self.folder.is_dir()

    def names(self) -> list[str]:
        """Names of all folders that look like takes, sorted."""
        if not self.exists():
            return []
        found = (p for p in self.folder.glob(f"*{SUFFIX}") if p.is_dir() and p.name[0] != ".")
        return sorted(p.name.removesuffix(SUFFIX) for p in found)

    def describe(self, name: str) -> str:
        """Path of a take."""
        return str(self.path(name))

    def is_there(self, name: str) -> bool:
        """Whether a take's folder exists."""
        return self.path(name).is_dir()

    def may_write(self, name: str) -> bool:
        """Whether nothing of that name exists: a folder appears whole, so whatever is there is meant."""
        return not self.path(name).exists()

    def header(self, name: str) -> bytes | None:
        """Content of a take's header; None if it has none."""
        try:
            return (self.path(name) / HEADER_FILE).read_bytes()
        except (FileNotFoundError, NotADirectoryError):
            return None

    def sizes(self, name: str, files: Mapping[str, int]) -> dict[str, int]:
        """Sizes in bytes of those files that are there, by path relative to the take."""
        found, folder = {}, str(self.path(name))
        for path in files:
            try:
                found[path] = os.stat(f"{folder}/{path}").st_size
            except (FileNotFoundError, NotADirectoryError):
                continue
        return found

    def zarr_group(self, name: str, arrays_at: str) -> tuple[StoreLike, str]:
        """Zarr store and path in it of the group that holds a take's arrays."""
        return str(self.path(name)), arrays_at

    @contextmanager
    def draft(self, name: str) -> Iterator[Draft]:
        """A new take; what was not committed at the end is removed."""
        self.folder.mkdir(parents=True, exist_ok=True)
        _remove_abandoned(self.folder)
        temporary = self.folder / f"{_TEMPORARY}{socket.gethostname()}-{os.getpid()}-{uuid.uuid4().hex[:8]}"
        try:
            yield _LocalDraft(name, temporary, self.path(name))
        finally:
            shutil.rmtree(temporary, ignore_errors=True)

    def reaching(self) -> AbstractContextManager[None]:
        """Nothing: what the file system says is said."""
        return nullcontext()


class _LocalDraft:
    arrays_at = ""

    def __init__(self, name: str, temporary: Path, target: Path) -> None:
        self._name, self._temporary, self._target = name, temporary, target

    def add(self, path: str, data: bytes | memoryview) -> None:
        file = self._temporary / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(data)

    def commit(self, header: bytes) -> None:
        self.add(HEADER_FILE, header)
        _sync(self._temporary)
        try:
            self._temporary.rename(self._target)
        except OSError as error:
            if self._target.exists():
                raise TakeError(
                    f"take {self._name!r}: {self._target} was written by another process meanwhile"
                ) from error
            raise
        _sync_folder(self._target.parent)


def _remove_abandoned(root: Path) -> None:
    """Remove what killed writers left behind, but not what living ones are writing."""
    for folder in root.glob(f"{_TEMPORARY}*"):
        host, _, rest = folder.name.removeprefix(_TEMPORARY).rpartition("-")[0].rpartition("-")
        ours = host == socket.gethostname() and rest.isdecimal()
        try:
            age_s = time.time() - folder.stat().st_mtime
        except FileNotFoundError:  # its writer has just finished
            continue
        if (ours and not _is_running(int(rest))) or age_s > _ABANDONED_AFTER_S:
            shutil.rmtree(folder, ignore_errors=True)


def _is_running(pid: int) -> bool:
    if os.name != "posix":  # signal 0 would be delivered as an interrupt there; age decides instead
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _sync(folder: Path) -> None:
    """Force every file and folder under ``folder`` to the disk, so that the rename cannot come first."""
    walked = list(os.walk(folder))
    files = [Path(parent) / file for parent, _, names in walked for file in names]
    # Side by side, because a disk takes many at a time and each waits for it.
    with ThreadPoolExecutor(_SYNCS_AT_ONCE) as pool:
        list(pool.map(_sync_file, files))
        list(pool.map(_sync_folder, [Path(parent) for parent, _, _ in walked]))


def _sync_file(file: Path, flags: int = os.O_RDWR) -> None:
    descriptor = os.open(file, flags)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _sync_folder(folder: Path) -> None:
    if os.name == "posix":  # folders cannot be opened elsewhere
        _sync_file(folder, os.O_RDONLY)
