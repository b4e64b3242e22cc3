"""Queries as a JSON file, which ``quest pick`` writes and every command reads."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from quest.errors import InputError, MissingExtraError
from quest.types import Query
from quest.untrusted import build, read_json, reading
from quest.whole_file import whole_file

VERSION = 1


@dataclass(frozen=True)
class _File:
    version: int
    queries: tuple[Query, ...]


def write_queries(queries: Sequence[Query], path: str | Path) -> None:
    """Write queries, all or nothing; a file that is there is replaced.

    Each is an object with the fields of :class:`quest.Query`, without those that are empty.
    """
    rows = [{key: value for key, value in asdict(query).items() if value not in (None, "")} for query in queries]
    with whole_file(Path(path)) as partial:
        partial.write_text(json.dumps({"version": VERSION, "queries": rows}, indent=1) + "\n", encoding="utf-8")


def read_queries(path: str | Path) -> list[Query]:
    """The queries of a file.

    Raises:
        InputError: there is no such file, it is no JSON or of another version, or a query is not as expected.
    """
    what = f"queries {path}"
    value = read_json(Path(path), InputError, "write it with quest pick")
    with reading(what, InputError, "write it with quest pick", known=MissingExtraError):  # also what a query refuses
        file = build(_File, value)
    if file.version != VERSION:
        raise InputError(f"{what}: format version {file.version}, expected {VERSION}; pick again")
    return list(file.queries)
