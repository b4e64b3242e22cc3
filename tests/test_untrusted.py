"""What comes from outside is checked before anything rests on it."""

from __future__ import annotations

import json
import os
from contextlib import suppress
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, Literal

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quest.cli.console import Console, shown
from quest.errors import InputError, QuestError, RecordingError, TakeError
from quest.types import TakeInfo
from quest.untrusted import (
    build,
    is_inside,
    is_name,
    parse_json,
    read_json,
    reading,
    require_file,
    require_table,
)

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=12,
)


class Kind(StrEnum):
    ONE = "one"


@dataclass(frozen=True)
class Inner:
    number: int
    share: float = 0.5


@dataclass(frozen=True)
class Outer:
    name: str
    inner: Inner
    kinds: tuple[Kind, ...] = ()
    pair: tuple[int, str] = (1, "a")
    side: Literal["left", "right"] = "left"
    maybe: float | None = None
    sizes: dict[str, int] = field(default_factory=dict)


def test_dataclasses_are_made_of_what_json_holds() -> None:
    value = {"name": "a", "inner": {"number": 3}, "kinds": ["one"], "pair": [2, "b"], "maybe": 1, "sizes": {"x": 4}}
    made = build(Outer, json.loads(json.dumps(value)))
    assert made == Outer("a", Inner(3), (Kind.ONE,), (2, "b"), "left", 1.0, {"x": 4})
    assert isinstance(made.maybe, float)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"name": 3}, "it.name"),
        ({"inner": {"number": True}}, "it.inner.number"),
        ({"inner": {"number": 2**70}}, "it.inner.number"),
        ({"inner": {"number": 1.0}}, "it.inner.number"),
        ({"inner": {"number": 1, "share": float("inf")}}, "it.inner.share"),
        ({"inner": {"number": 1, "share": 10**400}}, "it.inner.share"),
        ({"inner": {}}, "it.inner: lacks number"),
        ({"inner": [1]}, "it.inner"),
        ({"other": 1}, "has unknown other"),
        ({"kinds": ["two"]}, r"it.kinds\[0\]"),
        ({"kinds": "one"}, "it.kinds"),
        ({"pair": [1]}, "it.pair"),
        ({"side": "up"}, "it.side"),
        ({"sizes": {"x": "y"}}, "it.sizes.x"),
    ],
)
def test_what_does_not_fit_is_named(change: dict[str, Any], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        build(Outer, {"name": "a", "inner": {"number": 3}} | change)


@given(JSON)
def test_any_json_is_a_take_or_a_value_error(value: Any) -> None:
    with pytest.raises(ValueError, match="info"):
        build(TakeInfo, value, "info")


@given(st.binary(max_size=64))
def test_any_bytes_are_json_or_the_error_that_was_asked_for(data: bytes) -> None:
    with suppress(TakeError):
        parse_json(data, "x", TakeError)


@pytest.mark.parametrize("text", ["NaN", '{"a": Infinity}', "[" * 200_000, "", "{", "9" * 10_000])
def test_json_of_no_standard_is_refused(text: str, tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    file.write_text(text)
    with pytest.raises(RecordingError, match=r"a\.json: cannot be read"):
        read_json(file, RecordingError)


def test_only_ordinary_files_are_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    (tmp_path / "large").write_bytes(bytes(100))
    with pytest.raises(InputError, match="pipe: cannot be read as a file"):
        require_file(tmp_path / "pipe", InputError)
    with pytest.raises(InputError, match="it is a folder"):
        require_file(tmp_path, InputError)
    with pytest.raises(InputError, match="at most 99"):
        require_file(tmp_path / "large", InputError, most=99)
    for name in ("loop", "none", "n" * 300, "a\0b"):
        with pytest.raises(InputError, match="no such file" if name == "none" else "cannot be read"):
            require_file(tmp_path / name, InputError)


def test_a_table_has_no_more_rows_than_its_bytes_can_hold(tmp_path: Path) -> None:
    file = tmp_path / "t.parquet"
    pq.write_table(pa.table({"a": pa.repeat(1, 3_000_000)}), file, compression="zstd")
    with pytest.raises(RecordingError, match="3000000 rows"):
        require_table(file, RecordingError)
    pq.write_table(pa.table({"a": list(range(100))}), file)
    require_table(file, RecordingError)


def test_errors_of_the_kind_asked_for_pass_and_others_become_it() -> None:
    with pytest.raises(TakeError, match=r"^mine$"), reading("x", TakeError):
        raise TakeError("mine")
    with pytest.raises(RecordingError, match=r"x: cannot be read \(no camera\); y"), reading("x", RecordingError, "y"):
        raise InputError("no camera")
    with pytest.raises(QuestError, match=r"x: cannot be read \(KeyError: 'a'\)"), reading("x", QuestError):
        raise KeyError("a")


def test_names_and_paths_in_files_stay_inside() -> None:
    assert all(map(is_name, ("lockers-13-L4-s000001", "schöner Schrank (2)")))
    assert is_inside("view_0/rgb/c/0/0")
    for name in ("", ".", "..", "../a", "a/b", "a\\b", ".hidden", "a\0b", "n" * 300, "a\x1b[2J", 3, None):
        assert not is_name(name), name
    for path in ("", "/a", "../a", "a/../../b", "a\\b", "a\0b", 3, None):
        assert not is_inside(path), path


def test_control_characters_are_written_out(capsys: pytest.CaptureFixture[str]) -> None:
    assert shown("a\x1b[2Jb\tc\n") == "a\\x1b[2Jb\tc\n"
    console = Console(force_terminal=True, color_system="truecolor", markup=False, highlight=False)
    console.print("a\x1b]0;x\x07b", style="red")
    out = capsys.readouterr().out
    assert "\\x1b]0;xb" in out
    assert "\x1b[31m" in out
