"""Figures in documents are those of the result files."""

from __future__ import annotations

import json

import pytest

from benchmarks import update_pages as update

RESULTS = update.ROOT / "benchmarks" / "results"
REPORT = {"command": "quest eval", "commit": "0123456789abcdef"}


def test_pages_are_up_to_date():
    pages = update.pages(RESULTS)
    assert {page.name for page in pages} >= {"README.md", "results.md", "quest-s16-apache.md"}
    assert [page for page, text in pages.items() if page.read_text(encoding="utf-8") != text] == []


def test_a_missing_answer_has_no_pixels():
    """224 sqrt(2) px is how `quest eval` counts it, and no distance that anybody measured."""
    assert [page for page, text in update.pages(RESULTS).items() if "316.8" in text] == []


def test_the_summary_has_at_most_six_columns():
    assert len(update.SUMMARY) <= 6
    table = [line for line in update.summary(RESULTS).splitlines() if line.startswith("|")]
    assert {line.count("|") for line in table} == {len(update.SUMMARY) + 1}


def test_real_recordings_come_first_in_the_summary(tmp_path):
    rows = [
        {"of": "tracks", "tracker": name, "inputs": inputs, "units": 2, "targets": 5, "measures": {"within_16": share}}
        for name, inputs, share in [
            ("quest", "depth and poses", {"mean": 0.5, "low": 0.25, "high": 0.75}),
            ("quest", "depth", {"mean": 0.25, "low": 0.125, "high": 0.5}),
            ("lk-grid", "colours", {"mean": 0.75, "low": 0.5, "high": 1.0}),
        ]
    ]
    (tmp_path / "real").mkdir()
    (tmp_path / "real" / "posed.json").write_text(json.dumps({"run": REPORT, "rows": rows}))
    (tmp_path / "test.json").write_text((RESULTS / "test.json").read_text())
    lines = update.summary(tmp_path).splitlines()[2:]
    assert lines[0] == ("| real RGB-D, camera poses given | 2/5 | within 16 px, % | 50 (25–75) | 75 (50–100) |  |")
    assert lines[1] == "| real RGB-D, moving camera, no poses | 2/5 | within 16 px, % | 25 (12–50) | 75 (50–100) |  |"
    assert lines[2].startswith("| simulated")


def test_text_around_the_markers_stays():
    text = f"before\n{update.BEGIN}\nold\n{update.END}\nafter\n"
    assert update.between_markers(text, "new") == text.replace("old", "new")
    with pytest.raises(SystemExit, match="markers"):
        update.between_markers("no markers", "new")


def test_a_report_becomes_a_table(tmp_path):
    rows = [
        {"part": "test", "kind": "door", "share": {"mean": 0.25, "low": 0.125, "high": 0.5}, "left_out": None},
        {"part": "test", "kind": "lid", "share": {"mean": 1.0, "low": None, "high": None}, "left_out": None},
    ]
    (tmp_path / "a.json").write_text(json.dumps({"run": REPORT, "rows": rows}))
    columns = "part = part | kind = kind | right % = %share | wrong % = !%share | empty = left_out"
    section = update.as_section(update.Table("a.json", "Doors", columns), tmp_path)
    assert section.splitlines()[:7] == [
        "## Doors",
        "",
        "part: test",
        "",
        "| kind | right % | wrong % |",
        "| --- | --- | --- |",
        "| door | 25 (12–50) | 75 (50–88) |",
    ]
    assert "| lid | 100 | 0 |" in section
    assert "`quest eval`, commit 012345678." in section


def test_without_a_report_there_is_no_table(tmp_path):
    assert update.as_section(update.Table("none.json", "Nothing", "kind = kind"), tmp_path) == ""
    assert update.summary(tmp_path) == "No results yet."


def test_check_changes_nothing(tmp_path, monkeypatch, capsys):
    page = tmp_path / "page.md"
    page.write_text("old")
    monkeypatch.setattr(update, "pages", lambda folder: {page: "new"})
    assert update.UpdatePages(check=True).run() == 1
    assert page.read_text() == "old"
    assert "out of date" in capsys.readouterr().err
    assert update.UpdatePages().run() == 0
    assert page.read_text() == "new"
    assert update.UpdatePages(check=True).run() == 0
