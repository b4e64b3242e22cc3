"""``run.json`` of ``quest track``, and ``quest report`` on what is in a folder."""

from __future__ import annotations

import json
import shlex
import webbrowser
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from quest.cli.main import main, parse
from quest.cli.report import drift_of, measure_drift
from quest.cli.track import Track
from quest.data.store import TakeStore
from quest.tracks import read_tracks
from quest.types import Take, Tracks
from quest.viz.report import RunRecord, read_run
from tests.synthetic import make_take
from tests.viz.test_report import make_record, make_run, make_tracks

pytest.importorskip("jinja2")
pytest.importorskip("plotly")


@pytest.fixture(scope="module")
def take() -> Take:
    return make_take(frames=9, views=2, entities=2, name="panels")


@pytest.fixture(scope="module")
def store(take: Take, tmp_path_factory: pytest.TempPathFactory) -> Path:
    store = TakeStore(tmp_path_factory.mktemp("report") / "takes")
    store.write(take)
    return store.root


def true_tracks(take: Take) -> Tracks:
    """Answers that are the truth of view 0, under names of their own."""
    view, k = take.views[0], len(take.info.entities)
    tracks = make_tracks(frames=len(take), names=tuple(f"query {i}" for i in range(k)))
    return replace(tracks, uv_px=view.uv_px, point_world=take.point_world, joints=None)


def of_recording(given: str) -> RunRecord:
    run = make_record()
    return replace(run, recording=replace(run.recording, given=given))


@pytest.mark.slow
def test_track_then_report(take: Take, store: Path, weights: str, tmp_path: Path, capsys):
    out = tmp_path / "a run"
    x, y = take.views[1].uv_px[0, 1].tolist()
    words = [f"{store}/panels.zarr", "--view", "1", "--weights", weights, "--point", f"0,{x:.1f},{y:.1f},it's"]
    words += ["--out", str(out), "--no-overlay"]
    assert main(["track", *words]) == 0
    run = read_run(out)
    assert run is not None
    assert parse(shlex.split(run.command)[1:]) == parse(["track", *words])
    assert (run.recording.given, run.recording.view, run.recording.frames) == (words[0], 1, 9)
    assert run.recording.camera == take.views[1].clip.camera
    assert run.queries is not None
    assert [query.name for query in run.queries] == ["it's"]
    assert run.weights_hash is not None
    assert run.took_s > 0
    capsys.readouterr()
    assert main(["report", str(out)]) == 0
    assert str(out / "report.html") in capsys.readouterr().out
    page = (out / "report.html").read_text(encoding="utf-8")
    assert take.info.entities[1].name in page
    assert 'id="drift"' in page


@pytest.mark.parametrize(
    "words",
    [
        ["sample"],
        ["a b.mp4", "--no-overlay", "--online", "--point", "0,1,2,it's", "--point", "3,4,5", "--label", "rim:open"],
        ["x.mcap", "--topic-rgb", "/rgb", "--sync-s", "0.1", "--fov", "60", "--alpha", "0.1", "--alpha-frames", "300"],
        ["x", "--text=-odd", "--queries", "q.json", "--depth", "d e", "--rerun", "--rrd", "x.rrd", "--device", "cpu"],
    ],
)
def test_the_words_of_a_command_make_it_again(words: list[str]):
    command = parse(["track", *words])
    assert isinstance(command, Track)
    assert parse(shlex.split(command.command)[1:]) == command


@pytest.mark.parametrize("damage", ["none", "no tracks", "damaged record"])
def test_errors_are_one_line(tmp_path: Path, damage: str, capsys):
    folder = tmp_path / "run"
    if damage != "none":
        folder.mkdir()
    if damage == "damaged record":
        make_run(folder, make_tracks(), video=False)
        (folder / "run.json").write_text(json.dumps({"version": 1}))
    assert main(["report", str(folder)]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert not (folder / "report.html").exists()


def test_out_and_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda url: bool(opened.append(url)))
    run, page = make_run(tmp_path / "run", make_tracks(), video=False), tmp_path / "pages" / "mine.html"
    assert main(["report", str(run), "--out", str(page), "--open"]) == 0
    assert opened == [page.as_uri()]
    assert "no browser could be opened" in capsys.readouterr().out
    assert page.is_file()
    assert not (run / "report.html").exists()
    assert len(read_tracks(run / "tracks.parquet")) == 20


def test_drift_is_of_the_nearest_entity_at_first(take: Take):
    tracks = true_tracks(take)
    point = tracks.point_world[:, ::-1].copy()  # in another order than the truth
    point[4:, 1] = np.nan
    drift = measure_drift(replace(tracks, point_world=point), take)
    assert drift.entity == tuple(entity.name for entity in take.info.entities[::-1])
    np.testing.assert_allclose(drift.distance[:, 0], 0, atol=1e-6)
    np.testing.assert_allclose(drift.distance[4:, 1], drift.missing)
    np.testing.assert_allclose(drift.accuracy, [1, 4 / 9])


def test_no_drift_before_a_query_is_bound_and_of_what_is_nowhere(take: Take):
    tracks = true_tracks(take)
    uv, point = tracks.uv_px.copy(), tracks.point_world.copy()
    uv[:3, 0], point[:3, 0] = np.nan, np.nan
    point[:, 1] += 5
    drift = measure_drift(replace(tracks, uv_px=uv, point_world=point), take)
    assert drift.entity == (take.info.entities[0].name, None)
    assert np.isnan(drift.distance[:3, 0]).all()
    np.testing.assert_allclose(drift.distance[3:, 0], 0, atol=1e-6)
    assert np.isnan(drift.distance[:, 1]).all()


def test_why_there_is_no_drift(take: Take, store: Path):
    tracks, given = true_tracks(take), f"{store}/panels.zarr"
    assert not isinstance(drift_of(tracks, of_recording(given)), str)
    assert "without run.json" in str(drift_of(tracks, None))
    assert "at a URL" in str(drift_of(tracks, of_recording("s3://bucket/a.zarr")))
    assert "no take" in str(drift_of(tracks, of_recording("video.mp4")))
    assert "cannot be read" in str(drift_of(tracks, of_recording(f"{store}/none.zarr")))
    assert "9 frames and the tracks have 20" in str(drift_of(make_tracks(), of_recording(given)))
