"""The page about a run: what it says of odd runs, what it never lets through, and that a browser shows it."""

from __future__ import annotations

import html
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from quest.data.video import write_video
from quest.errors import InputError
from quest.types import Camera, Joints, Query, State, Tracks
from quest.viz.palette import query_colour
from quest.viz.report import Drift, Recorded, RunRecord, read_run, write_report, write_run
from quest.viz.report.plots import MOST_BINS, Thinning, coordinates, drift_plot, time_lines, world
from tests.browser import Page, browse, needs_browser

pytest.importorskip("jinja2")
graph_objects = pytest.importorskip("plotly.graph_objects")

EVIL = (
    "<script>alert(1)</script>",
    "</script><img src=x onerror=alert(2)>",
    "\"quotes' & <b>",
    "bell\x07\u202enul\x00",
)


def make_tracks(*, frames: int = 20, names: tuple[str, ...] = ("door", "drawer", "side")) -> Tracks:
    """Query 0 turns and raises an alarm, 1 slides, the others stand still; the camera moves."""
    k, t = len(names), np.arange(frames, dtype=np.float32)
    q = np.full((frames, k), np.nan, np.float32)
    point = np.random.default_rng(0).uniform(-1, 1, (1, k, 3)).repeat(frames, axis=0).astype(np.float32)
    joints = Joints.unknown(frames, k)
    kinds = ["revolute", "prismatic", *["static"] * k][:k]
    for i, kind in enumerate(kinds[:2]):
        q[:, i] = t / frames
        joints.axis[i], joints.origin[i] = (0, 0, 1), (0.5, 0, 0)
        joints.q_min_seen[i], joints.q_max_seen[i] = 0, q[-1, i]
        point[:, i, :2] += (
            np.stack([np.sin(q[:, i]), np.cos(q[:, i])], axis=-1) if kind == "revolute" else q[:, i, None]
        )
    state = np.full((frames, k), State.TRACKING.value, dtype="<U8")
    state[frames // 2 : frames // 2 + 2, :1] = State.LOST.value
    lost_p = np.where(state == State.LOST.value, np.float32(0.9), np.float32(0.1))
    poses = np.eye(4)[None].repeat(frames, axis=0)
    poses[:, 0, 3] = t / frames
    return Tracks(
        names=names, labels=("handle",) * k, uv_px=np.full((frames, k, 2), 8, np.float32), point_world=point,
        confidence=1 - lost_p, visible=state == State.TRACKING.value, state=state,
        stamp_s=np.arange(frames) / 10 + 1.7e9, lost_p=lost_p, alarm=state == State.LOST.value,
        joints=replace(joints, kind=tuple(kinds), q=q), cam_from_world=poses,
    )  # fmt: skip


def make_run(folder: Path, tracks: Tracks, *, video: bool = True) -> Path:
    tracks.save(folder)
    if video:
        frames = np.random.default_rng(1).integers(0, 255, (len(tracks), 48, 64, 3), dtype=np.uint8)
        write_video(folder / "overlay.mp4", frames, frames_per_s=10)
    return folder


def make_record(frames: int = 20) -> RunRecord:
    camera = Camera(60, 60, 32, 24, 64, 48)
    return RunRecord(
        quest="1.2.3", date="2026-01-02T03:04:05+00:00", command="quest track 'my clip.mp4' --point 0,1,2",
        recording=Recorded("my clip.mp4", 0, "my clip", frames, camera, has_depth=True, notes=("a note",)),
        weights="quest-s16", weights_hash="ab" * 32, alpha=0.05, alpha_frames=None, device="cpu",
        queries=(Query.point(0, 1, 2), Query.semantic("rim", intent="lift")), overlay=True, took_s=2.0,
    )  # fmt: skip


def plots_of(page: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="plots">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    return json.loads(found[1])


def text_of(page: str) -> str:
    """What one reads: without scripts, styles and marks."""
    return html.unescape(re.sub(r"<[^>]*>", "", re.sub(r"<(script|style)\b.*?</\1>", "", page, flags=re.DOTALL)))


def read(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def test_a_record_comes_back(tmp_path: Path):
    write_run(make_record(), tmp_path)
    assert read_run(tmp_path) == make_record()
    assert [path.name for path in tmp_path.iterdir()] == ["run.json"]
    path = tmp_path / "run.json"
    value = json.loads(path.read_text())
    for damaged in (
        value | {"version": 99}, value | {"took_s": "long"}, value | {"extra": 1}, [value],
        {key: each for key, each in value.items() if key != "device"},
        value | {"recording": value["recording"] | {"camera": {"fx": 1}}},
    ):  # fmt: skip
        path.write_text(json.dumps(damaged))
        with pytest.raises(InputError, match=r"run\.json.*track again"):
            read_run(tmp_path)


def test_no_folder_and_no_tracks(tmp_path: Path):
    with pytest.raises(InputError, match="no such folder"):
        write_report(tmp_path / "none")
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="this is a file"):
        write_report(tmp_path / "file")
    with pytest.raises(InputError, match=r"expected tracks\.parquet"):
        write_report(tmp_path)
    make_run(tmp_path, make_tracks(), video=False)
    with pytest.raises(InputError, match="this is a folder"):
        write_report(tmp_path, tmp_path)


def test_a_whole_run(tmp_path: Path):
    make_run(tmp_path, make_tracks())
    write_run(make_record(), tmp_path)
    page = read(write_report(tmp_path))
    text = text_of(page)
    for words in (
        "my clip",
        "door turned",
        "An alarm for door opened at 1.0 s",
        "--point 0,1,2",
        "Query.point(0, 1, 2",
        "abab",
    ):
        assert words in text
    assert 'src="data:video/mp4;base64,' in page
    assert page.count("plotly.js v") == 1, "inlined once"
    assert not re.search(r"<(link|script|img|iframe|video)\b[^>]*(src|href)=\"(?!data:)", page), "nothing is fetched"
    assert {plot["id"] for plot in plots_of(page)["plots"]} == {
        "time-lines", "joint-revolute", "joint-prismatic", "world",
    }  # fmt: skip
    assert not list(tmp_path.glob(".*partial*"))


def test_a_video_that_is_none_or_of_another_run(tmp_path: Path):
    make_run(tmp_path, make_tracks(frames=30))
    make_tracks(frames=20).save(tmp_path)
    assert "The video has 30 frames, the tracks have 20" in text_of(read(write_report(tmp_path)))
    write_run(replace(make_record(), overlay=False), tmp_path)
    assert "is of an earlier run" in text_of(read(write_report(tmp_path)))
    write_run(make_record(7), tmp_path)
    (tmp_path / "overlay.mp4").write_bytes(b"no video")
    text = text_of(read(write_report(tmp_path)))
    assert "The video cannot be shown" in text
    assert "it does not belong to these tracks" in text


ODD: dict[str, Callable[[Tracks], Tracks]] = {
    "No entity was asked for or found.": lambda _: make_tracks(names=()),
    "1 frame": lambda _: make_tracks(frames=1),
    "No world point is known": lambda tracks: replace(
        tracks, point_world=tracks.point_world * np.nan, joints=None, cam_from_world=None
    ),
    "Nothing was monitored": lambda tracks: replace(tracks, lost_p=None, alarm=None),
    "No joint is known": lambda tracks: replace(tracks, joints=None),
    "door was never found": lambda tracks: replace(
        tracks, uv_px=tracks.uv_px * np.nan, point_world=tracks.point_world * np.nan
    ),
    "Summary": lambda tracks: replace(tracks, cam_from_world=np.full((len(tracks), 4, 4), np.nan)),
}


@pytest.mark.parametrize("said", ODD)
def test_odd_runs(tmp_path: Path, said: str):
    run = make_run(tmp_path, ODD[said](make_tracks()), video=False)
    text = text_of(read(write_report(run, tmp_path / "new" / "page.html")))
    for words in (said, "There is no overlay.mp4", "There is no run.json", "Nothing was compared"):
        assert words in text


def test_names_do_nothing_but_show(tmp_path: Path):
    tracks = make_tracks(names=EVIL)
    run = make_run(tmp_path, replace(tracks, frame_flags=(EVIL[0],), labels=EVIL))
    record = make_record()
    recording = replace(record.recording, name=EVIL[1], given=EVIL[0], notes=EVIL)
    write_run(replace(record, recording=recording, command=EVIL[1], weights=EVIL[2], device=EVIL[3]), run)
    drift = Drift(EVIL, np.full((20, 4), 0.2), np.ones(4), gate=0.1, unit_m=1.0, missing=1.0)
    page = read(write_report(run, compare=lambda *_: drift))
    assert "<script>alert" not in page
    assert "<img" not in page.partition("plotly.js v")[0]
    assert "\x07" not in page
    assert "\u202e" not in page
    text = text_of(page.partition("plotly.js v")[0])
    assert EVIL[0] in text
    assert EVIL[2] in text
    assert r"bell\x07\u202enul\x00" in text
    labels = [label["text"] for label in plots_of(page)["plots"][0]["layout"]["annotations"]]
    assert labels[0] == "&lt;script&gt;alert(1)&lt;/script&gt;", "Plotly reads marks in its texts"
    assert labels[2] == "\"quotes' &amp; &lt;b&gt;", "and no entity of quotes"


def test_plotly_takes_the_plots():
    tracks, thinning = make_tracks(), Thinning.of(20, 3)
    drift = Drift(("a", None, "b"), np.full((20, 3), 0.2), np.ones(3), gate=0.1, unit_m=1.0, missing=1.0)
    plots = [time_lines(tracks, thinning), *coordinates(tracks, thinning), world(tracks, thinning)]
    for plot in [*plots, drift_plot(tracks, drift, thinning)]:
        assert plot is not None
        graph_objects.Figure(plot.data, plot.layout)  # raises on what Plotly does not know
    colours = [
        trace["line"]["color"] for trace in plots[0].data if trace.get("customdata") and trace["type"] == "scatter"
    ]
    assert colours == [f"rgb{query_colour(k)}".replace(" ", "") for k in range(3)]


def test_the_axes_of_the_world_have_one_scale():
    plot = world(make_tracks(), Thinning.of(20, 3))
    assert plot is not None
    scene = plot.layout["scene"]
    scales = [scene["aspectratio"][name] / np.ptp(scene[f"{name}axis"]["range"]) for name in "xyz"]
    np.testing.assert_allclose(scales, scales[0], rtol=1e-6)


def test_thinning_keeps_peaks_and_gaps():
    values = np.zeros(12345)
    values[[777, 9000]] = 1, -1
    values[:100] = np.nan
    thinning = Thinning.of(len(values), 3)
    frames = thinning.extremes(values)
    assert {777, 9000} <= set(frames.tolist())
    assert len(frames) <= 2 * MOST_BINS
    assert frames.max() < len(values)
    assert np.isnan(values[frames[0]])
    assert thinning.largest(np.arange(12345))[-1] == 12344
    np.testing.assert_array_equal(Thinning.of(30, 64).extremes(np.arange(30.0)), np.arange(30))


@pytest.mark.slow
def test_a_long_run_makes_a_page_of_bounded_size(tmp_path: Path):
    size, noise = (2_000, 16), np.random.default_rng(0)
    tracks = replace(
        make_tracks(frames=size[0], names=tuple(f"query {k}" for k in range(size[1]))),
        lost_p=noise.uniform(size=size).astype(np.float32),
        state=noise.choice([state.value for state in State], size).astype("<U8"),
        alarm=noise.uniform(size=size) > 0.9,
    )
    page = write_report(make_run(tmp_path, tracks, video=False))
    assert page.stat().st_size < 8 * 2**20
    text = text_of(read(page))
    assert "Each point stands for 2 frames" in text
    assert "more alarms are not listed" in text


@needs_browser
@pytest.mark.slow
def test_a_browser_shows_it(tmp_path: Path):
    async def script(page: Page) -> None:
        await page.until("[...document.querySelectorAll('.plot')].every((each) => each.querySelector('svg.main-svg'))")
        await page.until("document.getElementById('video').readyState > 0")
        assert await page.run("document.querySelectorAll('.plot').length") == 4
        assert await page.run("document.getElementById('video').duration") == pytest.approx(2.0, abs=0.01)
        left = "parseFloat(document.querySelector('.cursor').style.left)"
        before = await page.run(left)
        await page.run("document.getElementById('seek').value = 12")
        await page.run("document.getElementById('seek').dispatchEvent(new Event('input'))")
        await page.until("Math.abs(document.getElementById('video').currentTime - 1.25) < 0.01")
        assert await page.run("document.getElementById('now').textContent") == "frame 12, 1.20 s"
        assert await page.run(left) - before > 50
        assert await page.run("document.documentElement.scrollWidth <= document.documentElement.clientWidth")

    run = make_run(tmp_path / "run", make_tracks(names=EVIL))
    assert browse(write_report(run).as_uri(), script) == []
