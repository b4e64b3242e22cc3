"""What comes from outside: files, and what stands in them, checked before anything rests on it."""

from __future__ import annotations

import json
import os
import re
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from math import isfinite
from pathlib import Path, PurePosixPath
from types import NoneType
from typing import Any, Literal, get_args, get_origin, get_type_hints

from quest.errors import MissingExtraError, QuestError

MOST_TEXT = 64 * 2**20
"""Bytes of text, JSON or XML, beyond which a file is not read."""
_LONGEST_NAME = 255
_MOST_ROWS = 8
"""Rows of a table per byte of its file."""


@contextmanager
def reading(
    where: object,
    error: type[QuestError],
    remedy: str = "copy it again",
    *,
    known: type[QuestError] | None = None,
) -> Iterator[None]:
    """Whatever a library throws at bad bytes becomes one error of a class that says what was read, and what to do.

    Errors that are ``known`` name it already, and pass; by default those of the class itself.
    """
    passed = (known or error, MissingExtraError)
    try:
        yield
    except passed:
        raise
    except Exception as failure:  # libraries throw what they like: of their own, of Python's, of what they rest on
        said = str(failure).strip().partition("\n")[0][:300]
        named = said if isinstance(failure, QuestError) else f"{type(failure).__name__}: {said}".removesuffix(": ")
        raise error(f"{where}: cannot be read ({named}); {remedy}") from failure


def require_file(
    path: Path, error: type[QuestError], remedy: str = "check the path", *, most: int | None = None
) -> None:
    """Refuse what is no ordinary file, as a pipe would be waited for without end, or has more than ``most`` bytes."""
    with reading(path, error, remedy):
        try:
            found = path.stat()
        except FileNotFoundError:
            raise error(f"{path}: no such file; {remedy}") from None
    if not stat.S_ISREG(found.st_mode):
        kind = "a folder" if stat.S_ISDIR(found.st_mode) else "no file of bytes, such as a pipe"
        raise error(f"{path}: cannot be read as a file: it is {kind}; {remedy}")
    if most is not None and found.st_size > most:
        raise error(f"{path}: cannot be read: {found.st_size} bytes, expected at most {most}; {remedy}")


def require_table(path: Path, error: type[QuestError]) -> None:
    """Refuse a Parquet file with more rows than its size can hold."""
    import pyarrow.parquet as pq

    require_file(path, error)
    with reading(path, error):
        rows = pq.read_metadata(path).num_rows
    if rows > _MOST_ROWS * path.stat().st_size:
        raise error(f"{path}: cannot be read: {rows} rows in {path.stat().st_size} bytes of Parquet; copy it again")


def read_json(path: Path, error: type[QuestError], remedy: str = "restore it") -> Any:
    """JSON of an ordinary file, as of :func:`parse_json`."""
    require_file(path, error, remedy, most=MOST_TEXT)
    with reading(path, error, remedy):
        text = path.read_text(encoding="utf-8")
    return parse_json(text, path, error, remedy)


def parse_json(text: str | bytes, where: object, error: type[QuestError], remedy: str = "restore it") -> Any:
    """JSON as the standard says it, without NaN and infinities; else an error that names where it stands."""

    def no_number(word: str) -> float:
        raise ValueError(f"{word} is no number of JSON")

    with reading(where, error, remedy):
        return json.loads(text, parse_constant=no_number)


def build(kind: Any, value: Any, name: str = "it") -> Any:
    """A value that JSON holds, as an annotation says: its words, numbers and lists checked, dataclasses made.

    A value of an annotation that is not known is taken as it is.

    Raises:
        ValueError: it is of another type, or a field is missing or not known; the message names the value.
    """
    origin, args = get_origin(kind), get_args(kind)
    if NoneType in args:
        inner = [arg for arg in args if arg is not NoneType]
        return None if value is None else build(inner[0], value, name) if len(inner) == 1 else value
    if origin is Literal:
        _expect(value in args, name, f"one of {', '.join(map(str, args))}", value)
    elif kind in (str, bool):
        _expect(type(value) is kind, name, "a text" if kind is str else "true or false", value)
    elif kind is int:
        _expect(type(value) is int and abs(value) < 2**63, name, "a whole number", value)
    elif kind is float:
        _expect(type(value) in (int, float) and abs(value) < 1e300 and isfinite(value), name, "a number", value)
        return float(value)
    elif isinstance(kind, type) and issubclass(kind, Enum):
        _expect(value in [each.value for each in kind], name, f"one of {', '.join(e.value for e in kind)}", value)
        return kind(value)
    elif origin in (tuple, list):
        _expect(isinstance(value, list), name, "a list", value)
        each = args[:1] * len(value) if origin is list or args[1:] == (...,) else args
        _expect(len(each) == len(value), name, f"{len(each)} values", value)
        return origin(build(of, item, f"{name}[{i}]") for i, (of, item) in enumerate(zip(each, value, strict=True)))
    elif kind is dict or origin is dict or origin is Mapping:
        _expect(isinstance(value, dict), name, "an object", value)
        return {key: build(args[1], item, f"{name}.{key}") for key, item in value.items()} if args else value
    elif isinstance(kind, type) and is_dataclass(kind):
        _expect(isinstance(value, dict), name, "an object", value)
        known = [f for f in fields(kind) if f.init]
        needed = [f.name for f in known if f.default is MISSING and f.default_factory is MISSING]
        unknown, missing = sorted(set(value) - {f.name for f in known}), [key for key in needed if key not in value]
        if unknown or missing:
            lacks, has = ", ".join(missing) or "nothing", ", ".join(unknown) or "none"
            raise ValueError(f"{name}: lacks {lacks}, has unknown {has}")
        hints = get_type_hints(kind)
        return kind(**{key: build(hints[key], item, f"{name}.{key}") for key, item in value.items()})
    return value


def _expect(right: bool, name: str, what: str, value: Any) -> None:
    if not right:
        raise ValueError(f"{name}: expected {what}, got {repr(value)[:60]}")


def is_name(text: object) -> bool:
    """Whether a text that stands in a file may be the name of a file: no path, not hidden, not too long."""
    return (
        isinstance(text, str)
        and 0 < len(os.fsencode(text)) < _LONGEST_NAME
        and text[0] != "."
        and not re.search(r"[/\\\x00-\x1f]", text)
    )


def is_inside(path: object) -> bool:
    """Whether a relative path that stands in a file stays in the folder that it is relative to."""
    if not isinstance(path, str) or re.search(r"[\\\x00]", path):
        return False
    parts = PurePosixPath(path).parts
    return bool(parts) and not PurePosixPath(path).is_absolute() and ".." not in parts
