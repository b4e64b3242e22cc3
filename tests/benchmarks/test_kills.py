"""What counts as the same after a kill."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from benchmarks.kills import contents
from quest.data.store import TakeStore
from tests.synthetic import make_take


def write(folder: Path, *, value: float = 1.0, stamp: str = "now") -> Path:
    folder.mkdir()
    save_file({"a": np.full(3, value, np.float32)}, folder / "w.safetensors")
    (folder / "r.json").write_text(json.dumps({"rows": [{"off": value, "wall": stamp}], "stamp": stamp}))
    return folder


def test_times_do_not_count_and_values_do(tmp_path: Path) -> None:
    first = contents(write(tmp_path / "a"))
    assert sorted(first) == ["r.json", "w.safetensors"]
    assert contents(write(tmp_path / "b", stamp="later")) == first
    other = contents(write(tmp_path / "c", value=2.0))
    assert all(other[name] != first[name] for name in first)


def test_what_is_being_written_is_left_out_and_what_is_torn_is_not(tmp_path: Path) -> None:
    folder = write(tmp_path / "a")
    (folder / ".w.partial-1.json").write_text("{")
    (folder / "checkpoints").mkdir()
    (folder / "checkpoints" / "w.safetensors").write_bytes(b"")
    assert len(contents(folder)) == 2
    (folder / "r.json").write_text("{")
    with pytest.raises(json.JSONDecodeError):
        contents(folder)


def test_takes_count_as_a_store_reads_them(tmp_path: Path) -> None:
    store = TakeStore(tmp_path / "a" / "takes")
    store.write(make_take(frames=2, views=1, entities=1, size=(16, 16), seed=1))
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    assert len(contents(tmp_path / "a")) == 1
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
