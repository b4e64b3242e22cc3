"""Where takes lie: a folder of the file system, or a prefix of an object store.

A location knows nothing of arrays. It lists takes, reads their headers, and writes the files of a new take so that the
take is there all at once or not at all. Files come as pairs of a path relative to the take and the content, the header
last.

An object store is S3 and what speaks its protocol, Google Cloud Storage, Azure, or this process's memory. There is no
rename, so a take's header is its commit: it is put last, and only where there is none. Each writer puts its files under
a prefix of its own inside the take, so that writers of the same take never mix; the header names the prefix that
counts, and whoever puts the header removes what others left there.
"""

from __future__ import annotations

import os
import re
import shutil
import socket
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit
from urllib.request import url2pathname

from quest.data.take_format import HEADER_FILE
from quest.errors import ConfigError, TakeError
from quest.extras import require
from quest.untrusted import require_file

if TYPE_CHECKING:
    from zarr.storage import StoreLike

SUFFIX = ".zarr"
SCHEMES = ("s3", "gs", "az", "memory", "s3a", "adl", "abfs", "abfss")
Files = Callable[[str], Iterator[tuple[str, bytes | memoryview]]]
"""Makes the files of a take whose arrays go to a subgroup of some name, or with none directly into the group."""

_TEMPORARY = ".tmp-"
_ABANDONED_AFTER_S = 24 * 3600.0
_SYNCS_AT_ONCE = 16
_PUTS_AT_ONCE = 8
_memories: dict[str, Any] = {}


class StoreError(TakeError):
    """A place for takes that cannot be reached: this says nothing about any take."""


def open_location(root: str | Path) -> Location:
    """The place that a path or URL names.

    Raises:
        ConfigError: it is a URL that cannot be used.
        MissingExtraError: it is in an object store and obstore is not installed.
    """
    text = str(root)
    if re.match(r"[a-z][a-z0-9]+:/([^/]|$)", text):  # not a drive letter
        raise ConfigError(f"store {text}: a URL needs two slashes, such as s3://bucket/takes; a Path loses one of them")
    if "://" not in text:
        return LocalFolder(Path(root))
    parts = urlsplit(text)
    return LocalFolder(Path(url2pathname(parts.path))) if parts.scheme == "file" else ObjectPrefix(text)


class LocalFolder:
    """Takes in a folder: each is made in a hidden folder beside the others, and a rename makes it a take."""

    parallel = 1
    """How many headers are best read at the same time."""

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
        file = self.path(name) / HEADER_FILE
        if not file.exists():
            return None
        require_file(file, TakeError)
        return file.read_bytes()

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

    def write(self, name: str, files: Files) -> None:
        """Write a new take.

        Raises:
            TakeError: another process wrote one of this name meanwhile.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        _remove_abandoned(self.folder)
        temporary = self.folder / f"{_TEMPORARY}{socket.gethostname()}-{os.getpid()}-{uuid.uuid4().hex[:8]}"
        try:
            for path, data in files(""):
                file = temporary / path
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_bytes(data)
            _sync(temporary)
            try:
                temporary.rename(self.path(name))
            except OSError as error:
                if self.path(name).exists():
                    raise _written_meanwhile(self, name) from error
                raise
            _sync_folder(self.folder)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)

    def reaching(self) -> AbstractContextManager[None]:
        """Nothing: what the file system says is said."""
        return nullcontext()


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
        pass  # of another user
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


class ObjectPrefix:
    """Takes under a URL such as ``s3://bucket/takes``.

    Endpoint, region and credentials come from the environment, by the names that the provider's own tools use
    (``AWS_ENDPOINT_URL``, ``AWS_ACCESS_KEY_ID``, ``GOOGLE_APPLICATION_CREDENTIALS``, ``AZURE_STORAGE_ACCOUNT_NAME``).
    ``memory://NAME`` lives as long as the process. Methods are those of :class:`LocalFolder`.

    Args:
        url: the place.

    Raises:
        ConfigError: no object store is named like that, or its settings contradict each other.
        MissingExtraError: obstore is not installed.
    """

    parallel = 16

    def __init__(self, url: str) -> None:
        self.url = url.rstrip("/")
        parts = urlsplit(self.url)
        if parts.scheme not in SCHEMES or not parts.netloc:
            raise ConfigError(
                f"store {url}: expected a folder, file://PATH or {', '.join(SCHEMES[:4])}://BUCKET/PREFIX"
            )
        self._obstore = require("obstore")
        if parts.scheme == "memory":
            self._store = _memories.setdefault(parts.netloc, require("obstore.store").MemoryStore())
            self._prefix = parts.path.strip("/")
        else:
            self._store, self._prefix = self._open(), ""

    def _open(self) -> Any:
        plain = os.environ.get("AWS_ENDPOINT_URL", "").startswith("http://")
        try:
            return require("obstore.store").from_url(
                self.url,
                client_options={"allow_http": True} if plain else None,
                retry_config={"max_retries": 5, "retry_timeout": timedelta(seconds=60)},
            )
        except require("obstore.exceptions").BaseError as error:
            raise ConfigError(f"store {self.url}: {_brief(error)}; see docs/scale.md for its settings") from error

    @contextmanager
    def reaching(self) -> Iterator[None]:
        """Turns what goes wrong between here and there into a StoreError."""
        try:
            yield
        except (require("obstore.exceptions").BaseError, PermissionError) as error:
            raise StoreError(
                f"store {self.url}: cannot be reached or used ({_brief(error)}); check the URL, the endpoint and "
                "the credentials in the environment, and try again"
            ) from error

    def exists(self) -> bool:
        """Whether any take is there."""
        return bool(self.names())

    def names(self) -> list[str]:
        """Names of everything that looks like a take, whole or not, sorted."""
        with self.reaching():
            found = self._obstore.list_with_delimiter(self._store, self._prefix or None)["common_prefixes"]
        last = (path.rpartition("/")[2] for path in found)
        return sorted(name.removesuffix(SUFFIX) for name in last if name.endswith(SUFFIX) and name[0] != ".")

    def describe(self, name: str) -> str:
        """URL of a take."""
        return f"{self.url}/{name}{SUFFIX}"

    def is_there(self, name: str) -> bool:
        """Whether any object of a take is there."""
        with self.reaching():
            return next(iter(self._obstore.list(self._store, self._key(name), chunk_size=1)), None) is not None

    def may_write(self, name: str) -> bool:
        """Whether there is no header: without one, whatever is there was left by a killed writer."""
        return self.header(name) is None

    def header(self, name: str) -> bytes | None:
        """Content of a take's header; None if it has none."""
        with self.reaching():
            try:
                return bytes(self._obstore.get(self._store, self._key(name, HEADER_FILE)).bytes())
            except FileNotFoundError:
                return None

    def sizes(self, name: str, files: Mapping[str, int] | None = None) -> dict[str, int]:
        """Sizes in bytes of all objects of a take, by path relative to it; one request however many there are."""
        start = len(self._key(name)) + 1
        with self.reaching():
            pages = self._obstore.list(self._store, self._key(name))
            return {found["path"][start:]: found["size"] for page in pages for found in page}

    def zarr_group(self, name: str, arrays_at: str) -> tuple[StoreLike, str]:
        """Zarr store and path in it of the group that holds a take's arrays."""
        from zarr.storage import ObjectStore

        return ObjectStore(self._store, read_only=True), self._key(name, arrays_at)

    def write(self, name: str, files: Files) -> None:
        """Write a new take; what was not committed is removed, unless its header may have arrived all the same."""
        writer = f"written-{uuid.uuid4().hex[:12]}"
        with self.reaching():
            try:
                header = self._put_arrays(name, files(writer))
            except BaseException:
                self._remove(name, lambda path: path.startswith(writer))
                raise
            self.commit(name, writer, header)

    def _put_arrays(self, name: str, files: Iterator[tuple[str, bytes | memoryview]]) -> bytes:
        """Put all but the header, which is handed back, a few at a time and no faster than they go."""
        pending, header = deque[Future[Any]](), b""
        with ThreadPoolExecutor(_PUTS_AT_ONCE, thread_name_prefix="quest-put") as pool:
            try:
                for path, data in files:
                    if path == HEADER_FILE:
                        header = bytes(data)
                        continue
                    if len(pending) >= 2 * _PUTS_AT_ONCE:
                        pending.popleft().result()
                    pending.append(pool.submit(self._obstore.put, self._store, self._key(name, path), data))
                for put in pending:
                    put.result()
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
        return header

    def commit(self, name: str, writer: str, header: bytes) -> None:
        """Put a take's header and remove what other writers left.

        Raises:
            TakeError: the take has a header already.
        """
        errors = require("obstore.exceptions")
        key = self._key(name, HEADER_FILE)
        try:
            self._obstore.put(self._store, key, header, mode="create")
        except errors.AlreadyExistsError as error:
            if self.header(name) != header:  # else it is ours: the answer to the first attempt was lost on its way
                self._remove(name, lambda path: path.startswith(writer))
                raise _written_meanwhile(self, name) from error
        except errors.NotSupportedError:
            # A store that cannot compare: the last of two writers wins, and neither may remove what the other has put.
            self._obstore.put(self._store, key, header)
            return
        self._remove(name, lambda path: path != HEADER_FILE and not path.startswith(writer))

    def _remove(self, name: str, which: Callable[[str], bool]) -> None:
        try:
            keys = [self._key(name, path) for path in self.sizes(name) if which(path)]
            if keys:
                self._obstore.delete(self._store, keys)
        except (require("obstore.exceptions").BaseError, TakeError, OSError):
            pass  # rubbish in nobody's way; the take itself is either there or not

    def _key(self, name: str, path: str = "") -> str:
        return "/".join(filter(None, (self._prefix, f"{name}{SUFFIX}", path)))


def _written_meanwhile(location: Location, name: str) -> TakeError:
    return TakeError(f"take {name!r}: {location.describe(name)} was written by another process meanwhile")


def _brief(error: Exception) -> str:
    """What an error of obstore says before it comes to its sources; of a server's XML only code and message."""
    text = str(error).partition("\n\nDebug source")[0]
    told = re.search(r"<Code>(.*?)</Code>\s*<Message>(.*?)</Message>", text, re.DOTALL)
    return f"{text.partition('<?xml')[0]}{told[1]}, {told[2]}" if told else " ".join(text.split())


Location = LocalFolder | ObjectPrefix
