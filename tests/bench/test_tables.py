"""Tables of the publication from the command line, on takes that are drawn instead of rendered."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from quest.baselines.hold_still import HoldStill
from quest.bench import training, workbench
from quest.bench.settings import Making
from quest.bench.tables import SHARES, TABLES, drift_rows
from quest.bench.trackers import ChainedFlow, NoisyColours
from quest.bench.variants import BASES, REMEDIES, trained_losses, without_3d
from quest.bench.workbench import Asked, Workbench, planned
from quest.bench.writing import Table, latex, markdown
from quest.cli import main as program
from quest.cli.bench import ALL, SMOKE
from quest.data.store import TakeStore
from quest.errors import ConfigError
from quest.evaluation.protocols import evaluate_point
from quest.evaluation.records import Subject
from quest.sim.plan import TakeSpec
from quest.types import Clip, Query, Tracks
from tests.paper.tiny import PAPER
from tests.synthetic import make_take

TAKES = {"teach": 0, "choose": 1, "motions": 2, "views": 3, "objects": 110_000, "hidden": 110_001, "lockers": 110_002}
TAKES["laptops"] = 110_003


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which all takes are there already; none has to be rendered."""
    folder = tmp_path_factory.mktemp("work")
    for name, seed in TAKES.items():
        take = make_take(frames=10, views=1, entities=1, size=(48, 48), seed=seed, name=f"panels-{seed}-L1-s000000")
        TakeStore(folder / "smoke" / "takes" / name).write(take)
    return folder


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is rendered, and the published network is a tiny one."""

    def there(_: Making, name: str) -> list[TakeSpec]:
        return [TakeSpec("procedural", f"panels-{TAKES[name]}", 1, 0)]

    monkeypatch.setattr(workbench, "planned", there)
    monkeypatch.setattr(training, "take_encoder", lambda network: None)
    tiny = replace(BASES["remedies"], network=replace(PAPER, place_from="map"))
    monkeypatch.setitem(BASES, "remedies", tiny)  # type: ignore[arg-type]


def bench(work: Path, out: Path, *tables: str) -> int:
    return program.main(["bench", *tables, "--smoke", "--work", str(work), "--out", str(out)])


@pytest.mark.slow
@pytest.mark.usefixtures("small")
def test_a_table_is_made_and_found_again(work: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    assert bench(work, tmp_path, "levels", "noise") == 0
    report = json.loads((tmp_path / "levels.json").read_text())
    rows = {row["line"]: row for row in report["rows"] if row["reading"] == "all"}
    lines = ["full", "no queries", "no 3D", "no smoothness", "flow + 0.01", "flow + 0.02", "flow + 0.05", "hold still"]
    assert list(rows) == lines
    assert report["smoke"] is True
    assert rows["full"]["difference"] is None
    assert rows["no 3D"]["published"] == {"ape": 0.081, "acc": 0.718}
    assert rows["flow + 0.01"]["metrics"]["ape"]["mean"] < rows["flow + 0.05"]["metrics"]["ape"]["mean"]
    text = (tmp_path / "levels.md").read_text()
    assert "these figures mean nothing" in text
    assert "| no smoothness |" in text
    assert r"\begin{tabular}" in (tmp_path / "levels.tex").read_text()
    for kind, start in (("svg", b"<?xml"), ("png", b"\x89PNG")):
        assert (tmp_path / f"levels.{kind}").read_bytes().startswith(start)
    noisy = json.loads((tmp_path / "noise.json").read_text())["rows"]
    assert {(row["line"], row["noise"]) for row in noisy} == {
        (line, noise)
        for line in ("quest", "hold-still", "lk-grid", "cotracker-retrained", "published network")
        for noise in (0.0, 0.05)
    }

    def refuse(*_: object) -> None:
        raise AssertionError("asked again")

    monkeypatch.setattr(workbench, "build", refuse)
    monkeypatch.setattr(training, "fit", refuse)
    assert bench(work, tmp_path / "again", "levels") == 0
    assert json.loads((tmp_path / "again" / "levels.json").read_text())["rows"] == report["rows"]


@pytest.mark.usefixtures("small")
def test_some_rows_alone(work: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    words = ["bench", "levels", "--smoke", "--work", str(work), "--out", str(tmp_path), "--lines"]
    assert program.main([*words, "hold still"]) == 0
    rows = json.loads((tmp_path / "levels.json").read_text())["rows"]
    assert {row["line"] for row in rows} == {"full", "hold still"}
    assert program.main([*words, "nothing"]) == program.EXIT_ERROR
    assert "expected some of full, no queries" in " ".join(capsys.readouterr().err.split())


@pytest.mark.slow
@pytest.mark.usefixtures("small")
def test_cases_and_curves(work: Path, tmp_path: Path):
    assert bench(work, tmp_path, "drift", "failures", "intents") == 0
    shares = {row["share"] for row in json.loads((tmp_path / "drift.json").read_text())["rows"]}
    assert shares == {*SHARES}
    assert (tmp_path / "drift.png").is_file()
    failures = json.loads((tmp_path / "failures.json").read_text())
    assert {row["line"] for row in failures["lockers"]} == {"quest", "hold-still", "lk-grid", "cotracker-retrained"}
    assert failures["occlusion"] == []  # nothing is hidden there
    assert json.loads((tmp_path / "intents.json").read_text())["answers"] == []  # nor to be opened


@pytest.mark.slow
@pytest.mark.usefixtures("small")
def test_a_run_of_other_settings_is_not_taken_for_this_one(
    work: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    assert bench(work, tmp_path, "window") == 0
    monkeypatch.setitem(SMOKE, "steps", 5)
    assert bench(work, tmp_path, "window") == program.EXIT_ERROR
    assert "begun with steps 4, now it is 5" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["comparison", "nothing"], "no table 'nothing'"),
        (["comparison", "--trackers", "nobody"], "tracker 'nobody'"),
        (["comparison", "--steps", "0"], "of 1 or more"),
        (["comparison", "--noise", "-1"], "of 0 or more"),
    ],
)
def test_what_cannot_be_asked_is_said(words: list[str], said: str, capsys: pytest.CaptureFixture[str]):
    try:
        code = program.main(["bench", *words])
    except SystemExit as stop:
        code = stop.code
    assert code == program.EXIT_ERROR
    assert said in " ".join(capsys.readouterr().err.split())


@pytest.mark.usefixtures("small")
def test_takes_of_other_settings_do_not_teach(
    work: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(TAKES, "teach", 77)
    monkeypatch.setattr(workbench, "produce", lambda *_, **__: None)
    assert bench(work, tmp_path, "window") == program.EXIT_ERROR
    assert "panels-0-L1-s000000 was made for other settings" in " ".join(capsys.readouterr().err.split())


def test_every_table_has_a_command():
    group = program.COMMANDS["bench"]
    assert isinstance(group, program.Group)
    assert set(group.commands) == {*TABLES, ALL, "tapvid"}


def test_takes_are_those_of_the_protocols():
    making = Making(levels=(1, 4), teach_levels=(1, 4))
    teach, motions, views, new = (planned(making, name) for name in ("teach", "motions", "views", "objects"))
    assert len(teach) == 13 * 2 * 4
    assert {spec.object_id for spec in teach} == {spec.object_id for spec in motions} == {s.object_id for s in views}
    assert not {spec.seed for spec in teach} & {spec.seed for spec in motions}
    assert not {spec.object_id for spec in teach} & {spec.object_id for spec in new}
    assert (teach[0].settings.every, motions[0].settings.every, motions[0].settings.views) == (4, 1, 1)
    assert all(spec.settings.fixed_scene for spec in (*teach, *motions, *new))
    assert not any(spec.settings.fixed_scene for spec in views)
    assert {spec.suite.tag for spec in planned(making, "hidden") if spec.suite} == {"occlusion60", "occlusion60alike"}


@pytest.mark.parametrize("base", BASES.values(), ids=BASES)
def test_variants_differ_from_what_they_vary_in_one_thing(base):
    assert without_3d(base).windows.depth_drop_share == 1.0
    assert {n for n, w in without_3d(base).losses.items() if w != base.losses.get(n)} == {"vel", "acc", "geo"}
    assert base.sized("window", 4) is base
    assert base.sized("slots", 16).network == replace(base.network, slots=16)
    assert [base.without(x, x).losses[x] for x in trained_losses(base)] == [0.0] * len(trained_losses(base))
    names = [v.name for v in (*REMEDIES.values(), without_3d(base), base.sized("slots", 16), base.sized("window", 2))]
    assert len(set(names)) == len(names)


def test_chained_flow_is_off_by_the_noise_of_its_steps():
    take = make_take(frames=200, views=1, entities=2)
    subject = Subject("flow", "point", "train", "procedural", 1, "panels-0")
    exact = evaluate_point(ChainedFlow(0.0), take, 0, subject)
    assert max(r.distance.max() for r in exact) < 1e-5
    noisy = evaluate_point(ChainedFlow(0.01, seed=3), take, 0, subject)
    again = evaluate_point(ChainedFlow(0.01, seed=3), take, 0, subject)
    assert all(np.array_equal(a.distance, b.distance) for a, b in zip(noisy, again, strict=True))
    assert 0.5 < np.mean([r.distance[-1] for r in noisy]) / (0.01 * np.sqrt(200 * 3)) < 1.5
    with pytest.raises(ConfigError, match="only be judged on takes"):
        ChainedFlow(0.01).track(take.views[0].clip)


def test_noise_of_colours_is_what_was_asked_for():
    clip, shown = make_take(frames=3, views=1).views[0].clip, list[Clip]()
    clip = replace(clip, rgb=np.full_like(clip.rgb, 128))

    class Watching(HoldStill):
        def track(self, clip: Clip, queries: Sequence[Query] | None = None) -> Tracks:
            shown.append(clip)
            return super().track(clip, queries)

    for _ in range(2):
        NoisyColours(Watching(), 0.05).track(clip, [Query.point(0, 10, 10)])
    assert shown[0].rgb.std() == pytest.approx(0.05 * 255, rel=0.03)
    assert shown[0].rgb.mean() == pytest.approx(128, abs=0.5)
    assert np.array_equal(shown[0].rgb, shown[1].rgb)


def test_drift_is_read_at_shares_of_a_take():
    take = make_take(frames=11, views=1, entities=2)
    subject = Subject("flow", "point", "train", "procedural", 1, "panels-0")
    records = evaluate_point(HoldStill(), take, 0, subject)
    rows = drift_rows([workbench.Answers("hold", seed, records) for seed in (0, 1)], resamples=10)
    assert {row["tracks"] for row in rows if row["reading"] == "all"} == {2}
    own = {row["share"]: row["metrics"]["distance"].mean for row in rows if row["reading"] == "all"}
    assert list(own) == list(SHARES)
    for share, value in own.items():
        assert value == pytest.approx(np.mean([r.distance[round(10 * share)] for r in records]))


def test_tables_are_written_for_people_and_for_papers():
    table = Table("x.json", "Title & more", "name = name | APE = metrics.ape | Acc % = %acc", only={"reading": "all"})
    rows = [
        {"name": "a_b", "reading": "all", "metrics": {"ape": {"mean": 0.5, "low": 0.4, "high": 0.6}}, "acc": 0.25},
        {"name": "left out", "reading": "moved", "metrics": {}, "acc": 1.0},
    ]
    assert "| a_b | 0.500 (0.400–0.600) | 25 |" in markdown(table, {"rows": rows})
    text = latex(table, {"rows": rows})
    assert r"a\_b & 0.500 (0.400--0.600) & 25 \\" in text
    assert r"\caption{Title \& more}" in text
    assert latex(table, {"rows": []}) == markdown(table, {"rows": []}) == ""


def test_where_nothing_is_there_takes_are_rendered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from rich.console import Console

    made: list[str] = []

    def render(specs, store, studio, *, report) -> None:
        made.extend(spec.name for spec in specs)

    monkeypatch.setattr(workbench, "produce", render)
    making = Making(work=tmp_path, levels=(1,), taught=("procedural:chest-0",))
    Workbench(making, Console(quiet=True)).takes("motions")
    assert made == ["chest-0-L1-published-s002000"]
    assert Asked("x", tracker="lk", noise=0.05).key == "lk-noise-0.05"


@pytest.mark.slow
@pytest.mark.usefixtures("small")
def test_time_and_memory_are_of_one_tracker_alone(tmp_path: Path):
    """Hold-still needs next to no time, and less memory than a process that has everything loaded."""
    from quest.bench.speed import QUERIES, speed_rows

    (row,) = speed_rows(Making(work=tmp_path), [Asked("hold-still", tracker="hold-still")])
    assert (row["line"], row["queries"], row["frames"]) == ("hold-still", QUERIES, 85)
    assert 0 < row["ms"].mean < 50
    assert row["memory_mib"] is None or 50 < row["memory_mib"] < 1500
