"""What studies share."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from rich.console import Console

from benchmarks.study import rows_table, select_in
from quest.data.store import TakeStore
from quest.errors import ConfigError
from quest.evaluation.bootstrap import Value
from tests.synthetic import make_take


def test_what_all_rows_share_stands_in_the_title() -> None:
    value = Value(0.5, 0.25, 0.75, 3)
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(rows_table("joints", [{"part": "test", "kind": kind, "epe": {"head": value}} for kind in ("a", "b")]))
    text = console.export_text()
    assert "joints: part test, epe head 0.500 (0.250–0.750)" in text
    assert "kind" in text


def test_takes_of_several_stores_have_different_names(tmp_path: Path) -> None:
    store = TakeStore(tmp_path)
    store.write(make_take(frames=2, views=1, entities=1, size=(16, 16), seed=7))
    assert select_in([store], split=("train",)) == [(store, {"panels-7": "train"})]
    with pytest.raises(ConfigError, match="twice"):
        select_in([store, store], split=("train",))
