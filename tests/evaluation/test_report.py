"""What reports are read from and how they are written."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from quest.errors import InputError
from quest.evaluation import Results, Run, write_results
from quest.evaluation.bootstrap import Value
from quest.evaluation.report import gather, origins_json, provenance, shown, write_report
from tests.evaluation.answers import make_answer

RUN = Run("quest eval", "abc", "def", None, None, 50, 0, "machine", {"python": "3"}, "2026-01-01T00:00:00", 1.0)


def test_records_come_with_their_origin(tmp_path: Path):
    for name, take in (("a", "t0"), ("b", "t1")):
        records = (make_answer(np.zeros(5), take=take),)
        write_results(Results(RUN, ()), tmp_path / f"{name}.json", records=records)
    (tmp_path / "b.json").unlink()
    paths = [tmp_path / f"{name}.records.parquet" for name in "ab"]
    records, origins = gather(paths)
    assert [r.take for r in records] == ["t0", "t1"]
    assert [o.records for o in origins] == ["a.records.parquet", "b.records.parquet"]
    assert (origins[0].run, origins[1].run) == (RUN, None)
    path = tmp_path / "deep" / "report.json"
    write_report(provenance() | {"origins": origins_json(origins)}, path)
    read = json.loads(path.read_text())
    assert read["origins"][0]["run"]["commit"] == "abc"
    assert {"command", "commit", "machine", "versions", "stamp"} <= set(read)
    assert [p.name for p in path.parent.iterdir()] == ["report.json"]
    with pytest.raises(InputError, match="twice"):
        gather([*paths, paths[0]])


def test_records_of_another_run_are_refused(tmp_path: Path):
    for name, take in (("a", "t0"), ("b", "t1")):
        write_results(Results(RUN, ()), tmp_path / f"{name}.json", records=(make_answer(np.zeros(5), take=take),))
    (tmp_path / "b.records.parquet").replace(tmp_path / "a.records.parquet")
    with pytest.raises(InputError, match="not those of"):
        gather([tmp_path / "a.records.parquet"])
    write_results(Results(RUN, ()), tmp_path / "a.json")
    assert not (tmp_path / "a.records.parquet").exists()


def test_no_number_is_written_that_is_none(tmp_path: Path):
    with pytest.raises(ValueError, match="JSON"):
        write_report({"value": float("nan")}, tmp_path / "report.json")
    assert not list(tmp_path.iterdir())


def test_shown():
    assert shown(Value(0.5, 0.25, 0.75, 3), decimals=1, factor=100) == "50.0 (25.0 to 75.0)"
    assert shown(Value(0.5, None, None, 3)) == "0.500"
    assert shown(None) == "-"
