"""``quest track`` and ``quest monitor`` on every kind of recording: the same frames give the same tracks."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tyro

from quest.cli.console import Console
from quest.cli.main import main
from quest.cli.progress import counting
from quest.cli.source import Source
from quest.cli.track import Track
from quest.data.camera_file import CameraFile, write_camera
from quest.data.frame_source import FrameSource
from quest.data.lerobot_export import Episode, export_lerobot
from quest.data.mcap_export import export_mcap
from quest.data.recording import write_recording
from quest.data.store import TakeStore
from quest.data.video import write_video
from quest.errors import InputError, RecordingError
from quest.track import Stream
from quest.tracks import read_tracks
from quest.types import Clip
from tests.synthetic import make_take
from tests.viz.test_report import make_tracks

FRAMES = 6


@pytest.fixture(scope="module")
def clip() -> Clip:
    clip = make_take(frames=FRAMES, views=1, entities=2, size=(64, 48), seed=3).views[0].clip
    assert clip.depth_m is not None
    return replace(clip, name="clip", depth_m=np.rint(clip.depth_m * 1000).astype(np.float32) / np.float32(1000))


@pytest.fixture(scope="module")
def sources(clip: Clip, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    root = tmp_path_factory.mktemp("sources")
    write_recording(clip, root / "folder", rgb="png", depth_scale_m=0.001)
    export_mcap(clip, root / "clip.mcap", rgb="raw")
    export_lerobot([Episode({"front": clip}, "look"), Episode({"front": clip}, "look again")], root / "lerobot")
    return {name: str(root / name) for name in ("folder", "clip.mcap", "lerobot")}


def track(source: str, weights: str, out: Path, *arguments: str) -> np.ndarray:
    command = ["track", source, "--weights", weights, "--point", "0,20,30", "--out", str(out), "--no-overlay"]
    assert main([*command, *arguments]) == 0
    return read_tracks(out / "tracks.parquet").uv_px


def test_the_same_frames_give_the_same_tracks(sources: dict[str, str], weights: str, tmp_path: Path):
    folder = track(sources["folder"], weights, tmp_path / "folder")
    np.testing.assert_array_equal(track(sources["clip.mcap"], weights, tmp_path / "mcap"), folder)
    dataset = track(sources["lerobot"], weights, tmp_path / "lerobot", "--episode", "1", "--camera-key", "front")
    assert dataset.shape == folder.shape


def test_notes_are_said(sources: dict[str, str], weights: str, tmp_path: Path, capsys):
    track(sources["clip.mcap"], weights, tmp_path / "out", "--topic-depth", "none")
    assert "note: clip: no topic of depth: colours only" in capsys.readouterr().err


def test_wrong_topics_are_explained(sources: dict[str, str], weights: str, capsys):
    assert main(["track", sources["clip.mcap"], "--weights", weights, "--topic-rgb", "/front"]) != 0
    error = " ".join(capsys.readouterr().err.split())
    assert "no topic /front (--topic-rgb); topics found: /camera/aligned_depth_to_color/camera_info" in error


def test_monitor_reads_frame_by_frame(
    sources: dict[str, str], weights: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
):
    def refuse(self: FrameSource) -> Clip:
        raise AssertionError("the whole clip was read")

    monkeypatch.setattr(FrameSource, "clip", refuse)
    lines = tmp_path / "frames.jsonl"
    for source in sources.values():
        command = ["monitor", source, "--weights", weights, "--point", "0,20,30", "--jsonl", str(lines)]
        assert main(command) == 0
        assert len([json.loads(line) for line in lines.read_text().splitlines()]) == FRAMES
    assert "the dataset has no camera poses" not in capsys.readouterr().out


def test_monitor_reads_videos_of_unknown_length_frame_by_frame(
    clip: Clip, weights: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
):
    """Matroska does not tell how many frames there are."""
    write_video(tmp_path / "rgb.mkv", clip.rgb, frames_per_s=30)
    write_camera(CameraFile(clip.camera), tmp_path / "camera.json")
    monkeypatch.setattr(FrameSource, "clip", lambda source: pytest.fail("the whole clip was read"))
    command = ["monitor", str(tmp_path), "--weights", weights, "--point", "0,20,30"]
    assert main(command) == 0
    assert f": {FRAMES} frames in" in capsys.readouterr().out
    assert main([*command, "--point", "99,5,5,far"]) == 2
    error = " ".join(capsys.readouterr().err.split())
    assert "far (from frame 99 on): expected a frame of" in error
    assert f"ended at frame {FRAMES - 1}" in error


def test_monitor_stops_where_the_recording_is_torn(
    sources: dict[str, str], weights: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
):
    steps, step = [], Stream.step

    def counted(self: Stream, *arguments, **named):
        steps.append(1)
        return step(self, *arguments, **named)

    monkeypatch.setattr(Stream, "step", counted)
    frames = sorted((Path(sources["folder"]) / "rgb").iterdir())
    kept = frames[4].read_bytes()
    frames[4].write_bytes(kept[:50])
    try:
        assert main(["monitor", sources["folder"], "--weights", weights, "--point", "0,20,30"]) != 0
    finally:
        frames[4].write_bytes(kept)
    assert len(steps) == 4
    assert "000004.png" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("point", "said"), [(f"{FRAMES},1,1", f"0 to {FRAMES - 1}, got {FRAMES}"), ("0,1,1,\udcff", "UTF-8")]
)
def test_points_beyond_the_end_and_names_that_are_no_utf8(sources: dict[str, str], point: str, said: str):
    source = Source(sources["clip.mcap"], point=(point,))
    with pytest.raises(InputError, match=said):
        source.queries(source.open())


def test_every_clip_has_a_folder_of_its_own(
    clip: Clip, sources: dict[str, str], weights: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("quest.track.Tracker.track", lambda _, clip, *__, **___: make_tracks(frames=len(clip)))
    store = TakeStore(tmp_path / "takes")
    take = make_take(frames=FRAMES, views=2, entities=2, size=(64, 48), name="a.b")
    store.write(take)
    store.write(replace(take, info=replace(take.info, name="a.c")))
    write_recording(clip, tmp_path / "drawer.1", rgb="png")
    write_recording(clip, tmp_path / "drawer.2", rgb="png")
    command = ["--weights", weights, "--point", "0,20,30", "--no-overlay"]
    for source in (["takes/a.b.zarr/"], ["takes/a.b.zarr", "--view", "1"], ["takes/a.c.zarr"], ["drawer.1"]):
        assert main(["track", *source, *command]) == 0
    assert main(["track", "drawer.2/", *command]) == 0
    for episode in ("0", "1"):
        assert main(["track", sources["lerobot"], "--episode", episode, *command]) == 0
    views, episodes = ["a.b-view0", "a.b-view1", "a.c-view0"], ["lerobot-000000-front", "lerobot-000001-front"]
    written = sorted(file.parent.name for file in Path("outputs").glob("*/tracks.parquet"))
    assert written == [*views, "drawer.1", "drawer.2", *episodes]


def test_names_become_folders(clip: Clip):
    folders = {
        "a/b": "a-b", "..": "clip", "C:\\x": "C--x", "sample": "sample", "caf\udce9": "caf-", "Küche 1.5": "Küche 1.5",
    }  # fmt: skip
    assert {name: Track("anything")._name(replace(clip, name=name)) for name in folders} == folders


@pytest.mark.parametrize(
    ("source", "words", "named"),
    [
        ("takes/a.zarr", ["--depth", "d"], "and this is a take"),
        ("takes/a.zarr", ["--camera", "c.json"], "and this is a take"),
        ("takes/a.zarr", ["--depth-scale-m", "0.001"], "and this is a take"),
        ("takes/a.zarr/", ["--episode", "2"], r"takes/a\.zarr/: --episode 2 is for a LeRobot v3 dataset"),
        ("folder", ["--episode", "1"], "--episode 1 is for a LeRobot v3 dataset, and this is a folder or video"),
        ("folder", ["--topic-depth", "none"], "--topic-depth none is for an MCAP file or a ROS bag"),
        ("clip.mcap", ["--camera-key", "front"], "--camera-key front is for a LeRobot v3 dataset"),
        ("lerobot", ["--sync-s", "0.1"], "--sync-s 0.1 is for an MCAP file or a ROS bag"),
        ("lerobot", ["--view", "1"], "--view 1 is for a take"),
        ("nowhere.mcap", [], "no such file or folder"),
    ],
)
def test_options_of_other_kinds_are_refused(sources: dict[str, str], source: str, words: list[str], named: str):
    with pytest.raises(RecordingError, match=named):
        tyro.cli(Track, args=[sources.get(source, source), *words]).open()


def test_a_store_where_a_take_is_expected(tmp_path: Path, weights: str, capsys):
    TakeStore(tmp_path / "takes").write(make_take(frames=2, views=1, size=(32, 24), name="only"))
    assert main(["track", str(tmp_path / "takes"), "--weights", weights]) == 2
    error = " ".join(capsys.readouterr().err.split())
    assert "a store of 1 take (only); name one, such as" in error


def test_any_video_is_tracked(clip: Clip, weights: str, tmp_path: Path, capsys):
    """Without a camera file: colours only, and the guess is said."""
    write_video(tmp_path / "mine.mp4", clip.rgb, frames_per_s=30)
    track(str(tmp_path / "mine.mp4"), weights, tmp_path / "out")
    captured = capsys.readouterr()
    assert captured.out.startswith("reading ")
    assert "guessed a focal length of 64 px, the longer side of the image" in captured.err
    track(str(tmp_path / "mine.mp4"), weights, tmp_path / "out", "--fov", "60")
    assert "a focal length of 55 px from --fov 60" in capsys.readouterr().err


def test_the_first_line_comes_before_anything_heavy_is_imported(tmp_path: Path):
    code = (
        "import sys, builtins\n"
        "from quest.cli.main import main\n"
        "heavy = ('torch', 'av', 'cv2', 'zarr', 'pyarrow', 'scipy')\n"
        "class Out:\n"
        "    encoding, errors = 'utf-8', 'strict'\n"
        "    def isatty(self): return False\n"
        "    def flush(self): pass\n"
        "    def write(self, text):\n"
        "        sys.__stdout__.write(text.strip() + str([m for m in heavy if m in sys.modules]))\n"
        "        sys.__stdout__.flush()\n"
        "        import os; os._exit(0)\n"
        "sys.stdout = Out()\n"
        "main(['track', 'sample'])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=60)
    assert done.stdout == "reading sample[]", done.stderr


def test_frames_that_do_not_fit_into_memory(sources: dict[str, str], monkeypatch: pytest.MonkeyPatch, capsys):
    monkeypatch.setattr("quest.cli.source._free_bytes", lambda: 1000)
    assert main(["track", sources["folder"]]) == 2
    error = " ".join(capsys.readouterr().err.split())
    assert "6 frames of 64 x 48 need" in error
    assert "quest monitor" in error


def test_frames_are_counted_in_lines_where_output_is_piped(monkeypatch: pytest.MonkeyPatch):
    now_s = iter(range(0, 100, 6))
    monkeypatch.setattr("quest.cli.progress.time.monotonic", lambda: next(now_s))
    out = io.StringIO()
    with counting(Console(file=out, width=80), "tracking", 6) as report:
        for done in range(1, 7):
            report(done)
    assert out.getvalue().splitlines() == [
        "tracking: 2 of 6 frames, 24 s left",
        "tracking: 4 of 6 frames, 12 s left",
    ]


def test_frames_are_counted_in_a_bar_in_a_terminal():
    out = io.StringIO()
    with counting(Console(file=out, width=80, force_terminal=True), "tracking", 6) as report:
        report(3)
    assert "3/6" in out.getvalue()


def test_tracks_in_rerun(sources: dict[str, str], weights: str, tmp_path: Path, capsys):
    pytest.importorskip("rerun")
    track(sources["folder"], weights, tmp_path / "out", "--rrd", str(tmp_path / "tracks.rrd"))
    assert (tmp_path / "tracks.rrd").stat().st_size > 1000
    assert "open it with: rerun" in capsys.readouterr().out


def test_rerun_without_the_extra_is_told_before_the_work(sources: dict[str, str], monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert main(["track", sources["folder"], "--rrd", "x.rrd"]) == 2
    assert "[viz]" in capsys.readouterr().err
