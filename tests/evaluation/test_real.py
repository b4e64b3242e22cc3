"""``quest eval --real``: formats of labelled recordings, measures against plain loops, going on after a stop."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

import quest
from quest.baselines import TRACKERS, line_up
from quest.baselines.hold_still import HoldStill
from quest.cli.evaluate import Eval
from quest.cli.main import main
from quest.data.recording import write_recording
from quest.errors import ConfigError, InputError
from quest.evaluation.real.measures import (
    Answers,
    discovery_measures,
    match_boxes,
    score_clip,
    score_picture,
    track_measures,
)
from quest.evaluation.real.run import KeptAnswers, evaluate_set
from quest.evaluation.real.sets import Labels, Picture, may_choose, open_set, read_labels
from quest.track import Tracker, TrackerConfig
from quest.types import Camera, Clip
from tests.evaluation.answers import known, mean
from tests.evaluation.fakes import Stopped
from tests.tiny import make_finder

FRAMES = 8
SHARED = Path(__file__).parents[3] / "shared" / "data" / "real" / "video"
RESULTS = Path(__file__).parents[2] / "benchmarks" / "results" / "real" / "video.json"


def make_clip(*, step_px: float = 2.0, depth: bool = False, seed: int = 0) -> Clip:
    """A texture that moves to the right, 96 x 64 pixels."""
    rng = np.random.default_rng(seed)
    image = cv2.GaussianBlur(rng.uniform(0, 255, size=(120, 200, 3)).astype(np.float32), (0, 0), 2)
    image = np.clip((image - image.mean()) * 6 + 128, 0, 255)
    shift = [np.array([[1, 0, step_px * t - 60], [0, 1, -20]], np.float32) for t in range(FRAMES)]
    rgb = np.stack([cv2.warpAffine(image, move, (96, 64)).astype(np.uint8) for move in shift])
    pose = np.tile(np.eye(4), (FRAMES, 1, 1))
    pose[:, 0, 3] = step_px * np.arange(FRAMES) / 100.0 * 2.0 * depth
    depth_m = np.full((FRAMES, 64, 96), 2.0, np.float32) if depth else None
    camera = Camera(100.0, 100.0, 48.0, 32.0, 96, 64)
    return Clip(
        "moving", camera, rgb, depth_m, np.arange(FRAMES) / 10, pose if depth else np.tile(np.eye(4), (FRAMES, 1, 1))
    )


def write_clip(folder: Path, *, labels: str = "labels.csv", step_px: float = 2.0, depth: bool = False) -> None:
    """A recording with two tracks: ``a`` moves as the texture does, ``b`` is asked for at frame 2 and later hidden."""
    clip = make_clip(step_px=step_px, depth=depth, seed=len(folder.name))
    write_recording(clip, folder, rgb="png")
    shift = 0.5 if labels == "truth.csv" else 0.0
    lines = ["track,kind,moves,frame,x,y,state"]
    for t in range(FRAMES):
        lines.append(f"a,handle,yes,{t},{30 + step_px * t - shift},{20 - shift},visible")
    for t, state in ((2, "visible"), (4, "visible"), (5, "occluded"), (6, "out")):
        place = ",,," if state == "out" else f",{50 + step_px * (t - 2) - shift},{40 - shift},"
        lines.append(f"b,rim,no,{t}{place}{state}")
    (folder / labels).write_text("\n".join(lines) + "\n")


@pytest.fixture
def clips(tmp_path: Path) -> Path:
    """Two clips of colours."""
    for name in ("one", "three"):
        write_clip(tmp_path / "mine" / name)
    return tmp_path / "mine"


def test_labels_say_what_is_asked_and_scored(clips: Path, tmp_path: Path) -> None:
    labels = read_labels(clips / "one" / "labels.csv")
    assert (labels.names, labels.moves.tolist()) == (("a", "b"), [True, False])
    assert [(q.frame, q.uv_px) for q in labels.queries()] == [(0, (30.0, 20.0)), (2, (50.0, 40.0))]
    assert [(labels.names[labels.track[i]], int(labels.frame[i])) for i in labels.scored] == [
        *(("a", t) for t in range(1, FRAMES)),
        *(("b", t) for t in (4, 5, 6)),
    ]
    np.testing.assert_allclose(labels.step_px, 2.0)
    write_clip(tmp_path / "exact" / "one", labels="truth.csv", depth=True)
    exact = read_labels(tmp_path / "exact" / "one" / "truth.csv")
    np.testing.assert_array_equal(exact.uv_px, labels.uv_px)  # pixel centres at integers, in that file


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("track,frame,x,y\na,0,1,1\n", "columns.*state"),
        ("track,frame,x,y,state\na,0,1,1,seen\n", "expected state.*got track a, frame 0, state seen"),
        ("track,frame,x,y,state\na,0,one,1,visible\n", "Row #2.*'one'"),
        ("track,frame,x,y,state\na,0,,1,visible\n", "x and y of what is visible"),
        ("track,frame,x,y,state\na,-1,1,1,visible\n", "frame from 0 on"),
        ("track,frame,x,y,state\na,0,1,1,visible\nb,0,1,1,occluded\n", "a visible label of every track.*b"),
        ("track,frame,x,y,state\n", "expected labels, got none"),
    ],
)
def test_labels_that_make_no_sense(clips: Path, text: str, match: str) -> None:
    (clips / "three" / "labels.csv").write_text(text)
    with pytest.raises(InputError, match=match):
        open_set(clips)


def test_labels_beyond_the_recording(clips: Path) -> None:
    with (clips / "one" / "labels.csv").open("a") as file:
        file.write(f"a,handle,yes,{FRAMES},1,1,visible\n")
    with pytest.raises(InputError, match=f"frames below {FRAMES}"):
        evaluate_set(open_set(clips), [HoldStill()], resamples=2, seed=0)


def test_what_is_no_set(tmp_path: Path) -> None:
    for folder in (tmp_path / "none", tmp_path):
        with pytest.raises(InputError, match="expected folders of clips"):
            open_set(folder)
    (tmp_path / "pictures").mkdir()
    with pytest.raises(InputError, match="pictures/ and labels"):
        open_set(tmp_path)


def test_scores_of_a_moving_texture(clips: Path, tmp_path: Path) -> None:
    rows, single = evaluate_set(open_set(clips), line_up(["hold-still", "lk"], weights=""), resamples=20, seed=0)
    by_name = {row.tracker: row.measures for row in rows}
    for row in rows:
        assert (row.of, row.inputs, row.units, row.targets, row.terms) == ("tracks", "colours", 2, 4, 20)
    assert mean(by_name["hold-still"]["median_px"]) == 7.0  # 2, 4 ... 14 px of a, 4 px of b
    near = known(by_name["lk"]["within_16"])
    assert (near.mean, near.count) == (1.0, 16)
    assert by_name["lk"]["lost_auroc"] is None
    assert [row.of for row in single] == ["one", "three"] * 2
    # With depth and poses, a row each for what is shown; far steps apart.
    write_clip(tmp_path / "posed" / "slow", labels="truth.csv", depth=True)
    write_clip(tmp_path / "posed" / "quick", labels="truth.csv", depth=True, step_px=17.0)
    trackers = line_up(["hold-still", "world-pnp", "world-given"], weights="")
    rows, _ = evaluate_set(open_set(tmp_path / "posed"), trackers, resamples=20, seed=0)
    assert [(row.of, row.tracker, row.inputs) for row in rows] == [
        (of, *what)
        for of in ("tracks", "tracks, wide steps")
        for what in (("hold-still", "colours"), ("world-pnp", "depth"), ("world-given", "depth and poses"))
    ]
    assert mean(rows[2].measures["median_px"]) < 0.01


def _random_scores(seed: int) -> list[tuple[Labels, Answers]]:
    rng = np.random.default_rng(seed)
    found = []
    for number in range(4):
        states = rng.choice(["visible", "occluded", "out"], size=(3, 6), p=[0.6, 0.25, 0.15])
        states[:, 0] = "visible"
        if number == 3:
            states[:, 1:] = "out"  # a clip without a visible label
        uv_px = rng.uniform(0, 60, size=(18, 2))
        labels = Labels(
            ("a", "b", "c"),
            np.array([True, False, number > 0]),
            np.repeat(np.arange(3), 6),
            np.tile(np.arange(6), 3),
            np.where((states.reshape(-1) == "out")[:, None], np.nan, uv_px),
            states.reshape(-1),
        )
        count = len(labels.scored)
        answers = Answers(
            np.where(rng.random((count, 1)) < 0.2, np.nan, uv_px[labels.scored] + rng.normal(0, 15, (count, 2))),
            rng.random(count) < 0.5,
            np.where(rng.random(count) < 0.2, np.nan, rng.random(count)),
        )
        found.append((labels, answers))
    return found


@pytest.mark.parametrize("seed", [0, 1])
def test_track_measures_against_a_plain_loop(seed: int) -> None:
    pairs = _random_scores(seed)
    measures = track_measures(
        [score_clip(labels, answers, diagonal_px=100.0) for labels, answers in pairs], far_px=24.0, resamples=50, seed=0
    )
    px, moved, mixed, hidden, occluded, near, far, covered = ([] for _ in range(8))
    worst: dict[tuple[int, int], float] = {}
    for c, (labels, answers) in enumerate(pairs):
        for row, i in enumerate(labels.scored):
            p, lost = answers.uv_px[row], answers.lost_p[row]
            if labels.state[i] != "visible":
                hidden.append(answers.visible[row])
                covered.append(lost)
                if labels.state[i] == "occluded":
                    occluded.append(answers.visible[row])
                continue
            error = 100.0 if np.isnan(p).any() else float(np.hypot(*(p - labels.uv_px[i])))
            px.append(error)
            if labels.moves[labels.track[i]]:
                moved.append(error)
            key = (c, int(labels.track[i]))
            worst[key] = max(worst.get(key, 0.0), error)
            nearest = np.inf
            for j in range(len(labels.track)):
                same = labels.frame[j] == labels.frame[i] and labels.state[j] == "visible"
                if same and labels.track[j] != labels.track[i] and not np.isnan(p).any():
                    nearest = min(nearest, float(np.hypot(*(p - labels.uv_px[j]))))
            mixed.append(error > 16 and nearest < error)
            if error <= 16:
                near.append(lost)
            if error > 24:
                far.append(lost)
    wrong = [s for s in (*far, *covered) if not np.isnan(s)]
    right = [s for s in near if not np.isnan(s)]
    expected = {
        "median_px": np.median(px),
        "within_16": np.mean(np.array(px) <= 16),
        "moved_median_px": np.median(moved),
        "never_beyond_50": np.mean(np.array(list(worst.values())) <= 50),
        "identity_errors": np.mean(mixed),
        "hidden_called_visible": np.mean(hidden),
        "occluded_called_visible": np.mean(occluded),
        "lost_p_near": np.nanmedian(near),
        "lost_p_far": np.nanmedian(far),
        "lost_p_hidden": np.nanmedian(covered),
        "lost_auroc": np.mean([(w > r) + 0.5 * (w == r) for w in wrong for r in right]),
    }
    for name, value in expected.items():
        got = known(measures[name])
        np.testing.assert_allclose(got.mean, value, err_msg=name)
        assert got.low is not None
        assert got.high is not None
        assert got.low <= got.high


def test_measures_of_nothing_are_blank() -> None:
    labels, answers = _random_scores(0)[3]
    silent = dataclasses.replace(answers, lost_p=np.full(len(answers.lost_p), np.nan))
    measures = track_measures([score_clip(labels, silent, diagonal_px=1.0)], far_px=16, resamples=5, seed=0)
    assert {name for name, value in measures.items() if value is not None} == {
        "hidden_called_visible",
        "out_called_visible",
    }


def make_picture(folder: Path, name: str, boxes: Sequence[Sequence[float]], **settings: object) -> Picture:
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((48, 64, 3), 128, np.uint8)).save(folder / name)
    array = np.reshape(boxes, (-1, 4)).astype(float)
    return dataclasses.replace(Picture(folder / name, array, np.ones(len(array), bool)), **settings)  # type: ignore[arg-type]


def grips(uv_px: np.ndarray, score: Sequence[float], *, least: float = -np.inf) -> dict[str, np.ndarray]:
    """What a tracker discovers, as the evaluation takes it: boxes of 6 x 10 pixels around pixels, and no panel."""
    half = np.array([3.0, 5.0])
    return {
        "uv_px": uv_px, "box_px": np.concatenate((uv_px - half, uv_px + half), axis=1), "score": np.array(score),
        "panel_px": np.zeros((0, 4)), "panel_kind": np.zeros(0, int), "panel_score": np.zeros(0),
        "bare_px": np.zeros((0, 4)), "bare_score": np.zeros(0), "least": np.array(least),
    }  # fmt: skip


def test_answers_take_a_free_handle_first(tmp_path: Path) -> None:
    picture = make_picture(tmp_path, "a.png", [(10, 10, 20, 20), (18, 10, 28, 20), (40, 40, 44, 44)])
    # Two answers where boxes overlap, a third in the first box, one 4 px beside the last box, one nowhere.
    uv_px = np.array([[19.0, 15.0], [19.0, 15.0], [12.0, 15.0], [48.0, 42.0], [60.0, 5.0]])
    found = score_picture(picture, grips(uv_px, [0.9, 0.8, 0.7, 0.6, 0.5]))
    assert found.right.tolist() == [True, True, True, True, False]
    assert found.again.tolist() == [False, False, True, False, False]
    assert found.found.all()
    np.testing.assert_allclose(found.size_px, [100, 100, 40])
    bars = make_picture(
        tmp_path, "b.png", [(10, 10, 50, 10), (10, 40, 50, 40)], bars=True, wanted=np.array([True, False])
    )
    assert np.isfinite(bars.closeness(np.array([[30.0, 21.9], [30.0, 22.1], [55.0, 10.0]]))[:, 0]).tolist() == [1, 0, 1]
    uv_px = np.array([[30.0, 41.0], [30.0, 11.0], [62.0, 25.0]])
    found = score_picture(bars, grips(uv_px, [0.3, 0.2, 0.1]))
    assert (found.right.tolist(), found.found.tolist()) == ([True, False], [True])  # what does not count is left out


def test_discovery_measures_against_a_plain_loop(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    pictures = []
    for number in range(3):
        boxes = [(x, 5, x + 6, 15) for x in range(0, 20 * number, 20)]  # the first picture has none
        picture = make_picture(tmp_path, f"{number}.png", boxes)
        candidates = rng.uniform((0, 0), (40, 20), size=(12, 2))
        score = np.sort(rng.random(12))[::-1]
        pictures.append(score_picture(picture, grips(candidates, score.tolist(), least=float(score[5]))))
    measures = discovery_measures(pictures, resamples=20, seed=0)
    handles = sum(len(p.found) for p in pictures)
    right = sum(int(p.right.sum()) for p in pictures)
    hits = sum(int((p.right & ~p.again).sum()) for p in pictures)
    precision, recall = hits / 15, sum(int(p.found.sum()) for p in pictures) / handles
    pooled = sorted(((s, f) for p in pictures for s, f in zip(p.score, p.first, strict=True)), reverse=True)
    curve, true = [], 0
    for n, (_, first) in enumerate(pooled, 1):
        true += int(first)
        curve.append((true / handles, true / n))
    area = sum(
        (r - before) * max(p for _, p in curve[i:])
        for i, ((r, _), before) in enumerate(zip(curve, [0.0, *(r for r, _ in curve)], strict=False))
    )
    expected = {
        "recall": recall,
        "precision": right / 15,
        "f1": 2 * precision * recall / (precision + recall),
        "ap": area,
    }
    for name, value in expected.items():
        np.testing.assert_allclose(mean(measures[name]), value, err_msg=name)


def test_boxes_are_right_that_share_half_of_their_union() -> None:
    true = np.array([[0.0, 0, 10, 10], [20, 0, 30, 10]])
    found = np.array([[0.0, 0, 10, 9], [0, 0, 9, 10], [20, 0, 30, 4.9], [20, 0, 30, 5.1]])
    boxes = match_boxes(found, np.array([4.0, 3, 2, 1]), true)
    assert boxes.first.tolist() == [True, False, False, True]
    assert boxes.labelled == 2


def test_doors_without_a_labelled_handle_are_told_apart(tmp_path: Path) -> None:
    doors = np.array([[0.0, 0, 30, 40], [32, 0, 62, 40]])
    picture = make_picture(tmp_path, "a.png", [(24, 15, 28, 25)], panels={"cabinet": doors})
    found = grips(np.zeros((0, 2)), []) | {"bare_px": doors, "bare_score": np.array([2.0, 1.0])}
    bare = score_picture(picture, found).boxes["bare"]
    assert (bare.first.tolist(), bare.labelled) == ([False, True], 1)


def test_pictures_are_split_by_name(tmp_path: Path) -> None:
    names = [f"{i:04d}.png" for i in range(40)] + ["ward-001.png", "ward-002.png"]
    assert may_choose("ward-001.png") == may_choose("ward-002.png")
    (tmp_path / "set" / "pictures").mkdir(parents=True)
    lines = ["file,width,height,class,x0,y0,x1,y1,licence"]
    for name in names:
        make_picture(tmp_path / "set" / "pictures", name, [])
        lines += [f"{name},64,48,handle,1,2,3,4,x", f"{name},64,48,door,1,2,30,40,x"]
    lines.append("empty.png,64,48,,,,,,x")
    make_picture(tmp_path / "set" / "pictures", "empty.png", [])
    (tmp_path / "set" / "labels.csv").write_text("\n".join(lines) + "\n")
    choosing = [picture.name for picture in open_set(tmp_path / "set", part="choosing").pictures]
    teaching = [picture.name for picture in open_set(tmp_path / "set", part="teaching").pictures]
    every = open_set(tmp_path / "set", part="all").pictures
    assert sorted(choosing + teaching) == sorted([*names, "empty.png"])
    assert 3 <= len(choosing) <= 15
    assert {p.name: len(p.boxes) for p in every}["empty.png"] == 0
    assert all(len(p.boxes) == 1 for p in every if p.name != "empty.png")
    (tmp_path / "set" / "pictures" / names[0]).unlink()
    with pytest.raises(InputError, match="expected a picture"):
        open_set(tmp_path / "set", part="all")


def test_what_was_stopped_goes_on(clips: Path, tmp_path: Path) -> None:
    real = open_set(clips)

    def run(tracker: HoldStill, made_by: str | None = None) -> object:
        kept = None if made_by is None else KeptAnswers(tmp_path / "parts", made_by=made_by)
        return evaluate_set(real, [tracker], resamples=5, seed=0, kept=kept)

    whole = run(HoldStill())
    with pytest.raises(KeyboardInterrupt):
        run(Stopped(1), "a")
    second = Stopped()
    assert run(second, "a") == whole
    assert len(second.clips) == 1
    other = Stopped()
    run(other, "b")
    assert len(other.clips) == 2  # answers of other code or data do not count
    (tmp_path / "parts" / "one.hold-still.colours.npz").write_bytes(b"PK")
    with pytest.raises(InputError, match="delete the file"):
        run(second, "b")


def test_command_writes_what_it_prints(
    clips: Path, tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    tracker = Tracker(make_finder(), TrackerConfig(bias=100.0, size_px=64, follow_px=64), device=torch.device("cpu"))
    monkeypatch.setattr(quest, "load", lambda weights: tracker, raising=False)
    pictures = tmp_path / "photos"
    (pictures / "pictures").mkdir(parents=True)
    make_picture(pictures / "pictures", "a.png", [])
    (pictures / "labels.csv").write_text("file,class,x0,y0,x1,y1\na.png,handle,10,10,40,30\n")
    command = Eval(
        real=(clips, pictures), trackers=("quest", "lk"), pictures="all", resamples=5, out=tmp_path / "results"
    )
    assert command.run() == 0
    printed = capsys.readouterr().out
    assert sorted(path.name for path in (tmp_path / "results").iterdir()) == ["mine.json", "photos.json"]
    raw = json.loads((tmp_path / "results" / "mine.json").read_text())
    assert {(row["tracker"], row["inputs"]) for row in raw["rows"]} == {("quest", "colours"), ("lk", "colours")}
    for row in raw["rows"]:
        assert f"{100 * row['measures']['within_16']['mean']:.1f}" in printed
        assert row["measures"]["lost_p_near"] is None
    assert len(raw["single"]) == 4
    assert set(raw["run"]) >= {"command", "commit", "data_hash", "weights", "weights_hash", "versions", "stamp"}
    found = json.loads((tmp_path / "results" / "photos.json").read_text())["rows"]
    assert [(row["of"], row["tracker"], row["units"], row["targets"]) for row in found] == [("pictures", "quest", 1, 1)]
    before = raw["run"]["data_hash"]
    (clips / "one" / "labels.csv").write_text((clips / "three" / "labels.csv").read_text().replace("b,rim", "c,rim"))
    assert open_set(clips).data_hash() != before


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"real": ()}, "--takes STORE or --real FOLDER"),
        ({"takes": "store"}, "--takes STORE or --real FOLDER"),
        ({"level": (1,)}, "--level is for --takes"),
        ({"same_objects": True}, "--same-objects is for --takes"),
        ({"out": Path("results.json")}, "folder"),
        pytest.param({"trackers": ("raft",)}, "expected one of quest", marks=pytest.mark.plain),
    ],
)
def test_command_errors(clips: Path, changes: dict, match: str) -> None:
    with pytest.raises(ConfigError, match="different names"):
        Eval(real=(clips, clips), trackers=("lk",)).run()
    with pytest.raises(ConfigError, match=match):
        dataclasses.replace(Eval(real=(clips,), trackers=("lk",)), **changes).run()


def test_command_names_the_trackers(capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit):
        main(["eval", "--real", "set", "--trackers", "raft"])
    refused = capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["eval", "--help"])
    explained = capsys.readouterr().out
    assert all(name in refused and name in explained for name in TRACKERS)


@pytest.mark.skipif(not (SHARED.is_dir() and RESULTS.is_file()), reason="no labelled videos beside the checkout")
def test_a_grid_of_lucas_kanade_scores_as_it_did() -> None:
    raw = json.loads(RESULTS.read_text())
    (expected,) = (row for row in raw["single"] if row["of"] == "laptop-close" and row["tracker"] == "lk-grid")
    real = open_set(SHARED)
    alone = dataclasses.replace(real, clips=tuple(clip for clip in real.clips if clip.name == "laptop-close"))
    (row,), _ = evaluate_set(alone, line_up(["lk-grid"], weights=""), resamples=2, seed=0)
    assert (row.targets, row.terms) == (expected["targets"], expected["terms"])
    for name, value in expected["measures"].items():
        np.testing.assert_allclose(mean(row.measures[name]), value, rtol=1e-3, err_msg=name)
