"""TAP-Vid and TAPVid-3D: metrics beside the reference evaluators', layouts of videos, the command."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from quest.baselines.chained import LucasKanade
from quest.cli.main import main
from quest.data.store import TakeStore
from quest.errors import InputError
from quest.evaluation.tapvid.run import follow
from quest.evaluation.tapvid.scores import Answered, redetection, survival, tapvid3d_scores, tapvid_scores
from quest.evaluation.tapvid.videos import read_video
from tests.evaluation.tapvid_cases import SEEDS, inputs
from tests.synthetic import make_take

REFERENCE = Path(__file__).parent / "tapvid_reference.npz"
"""What the reference evaluators say of ``tapvid_cases.inputs``, one seed after the other.

Made outside the project by running these on NumPy inputs of those seeds:

- ``compute_tapvid_metrics`` of ``tapnet/tapvid/evaluation_datasets.py``;
- ``compute_tapvid3d_metrics`` of ``tapnet/tapvid3d/evaluation/metrics.py`` (scaling by medians a video at a time: its
  factors do not broadcast over several);
- ``compute_redetection_metrics`` of ``tapnet/tapnextpp/metrics/aj_rd.py``, which averages in single precision;
- the survival of ``test_on_pod.py``, lines 137 to 141, with the published 50 pixels, of aharley/pips2 at
  8b5bd9ecb27274f76f75fcaeff0dbdf13de0b977.

The first three are of google-deepmind/tapnet at c2cbab81cc06092b5f05bfe2da7bfec54e2079c9. Values are in the order of
``PointScores.named``; of re-detection AJ_RD and what it is the mean of; of survival each track's.
"""


def ours(kind: str, case: dict[str, Any]) -> np.ndarray:
    """Our answer, in the order of the reference's."""
    fields = ("query_frame", "occluded", "points", "said_occluded", "said_points")
    answered = Answered(*(case[name] for name in fields))
    if kind == "redetection":
        by_least = redetection(answered)
        return np.append(np.nan if np.isnan(by_least).all() else np.nanmean(by_least), by_least)
    if kind == "survival":
        return survival(answered)
    if kind == "tapvid":
        scores = tapvid_scores(answered, queries=case["queries"], per_track=case["per_track"])
    else:
        scores = tapvid3d_scores(answered, **{k: case[k] for k in ("intrinsics", "scaling", "fixed", "per_track")})
    return np.concatenate([np.ravel(values) for values in scores.named().values()])


@pytest.mark.parametrize("kind", SEEDS)
def test_metrics_are_those_of_the_reference(kind: str) -> None:
    with np.load(REFERENCE, allow_pickle=False) as file:
        expected = file[kind]
    found = [ours(kind, inputs(kind, seed)) for seed in range(SEEDS[kind])]
    tolerance = 1e-6 if kind == "redetection" else 1e-12
    np.testing.assert_allclose(np.concatenate(found), expected, rtol=0, atol=tolerance, equal_nan=True)


def test_no_occlusion_is_ahead_of_the_query() -> None:
    occluded = np.array([[True, True, False, False, True, False]])
    points = np.zeros((1, 6, 2))
    said = points + np.array([0, 0, 99, 99, 0, 0])[:, None]
    for query, expected in ((0, [0.2, np.nan]), (2, [1.0, np.nan]), (5, [np.nan, np.nan])):
        found = redetection(Answered(np.array([query]), occluded, points, occluded, said))
        np.testing.assert_array_equal(found[[0, 2]], expected)


def test_survival_counts_a_missing_answer_as_missed() -> None:
    said = np.zeros((1, 4, 2))
    said[0, 2] = np.nan
    never = np.zeros((1, 4), bool)
    assert survival(Answered(np.array([1]), never, np.zeros((1, 4, 2)), never, said)).tolist() == [1 / 3]
    many = Answered(np.array([[1]]), never[None], np.ones((1, 1, 4, 3)), never[None], np.ones((1, 1, 4, 3)))
    with pytest.raises(InputError, match="one video"):
        tapvid3d_scores(many, np.ones((1, 4)), scaling="local_neighborhood")


def moving(frames: int = 12, step_px: float = 2.0, size: tuple[int, int] = (128, 96)) -> dict[str, np.ndarray]:
    """A video in the layout of TAP-Vid: a texture that moves to the right with two points, of which one is hidden."""
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.uniform(0, 255, (200, 300, 3)).astype(np.float32), (0, 0), 3)
    image = np.clip((image - image.mean()) * 9 + 128, 0, 255)
    shifts = [np.array([[1, 0, step_px * t - 60], [0, 1, -20]], np.float32) for t in range(frames)]
    video = np.stack([cv2.warpAffine(image, shift, size).astype(np.uint8) for shift in shifts])
    points = np.array(
        [[[30 + step_px * t, 40] for t in range(frames)], [[60 + step_px * t, 50] for t in range(frames)]]
    )
    occluded = np.zeros((2, frames), bool)
    occluded[1, [0, 1, 6, 7]] = True
    points[1, 6:8] = np.nan
    return {"video": video, "points": points / size, "occluded": occluded}


def write(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    np.savez(path, allow_pickle=True, **arrays)


def test_queries_of_both_modes(tmp_path: Path) -> None:
    write(tmp_path / "a.npz", moving())
    video = read_video(tmp_path / "a.npz")
    assert video.clip.rgb.shape == (12, 256, 256, 3)
    track, frame, uv_px = video.queries("first")
    assert (track.tolist(), frame.tolist()) == ([0, 1], [0, 2])
    np.testing.assert_allclose(uv_px, [[60, 40 * 256 / 96], [128, 50 * 256 / 96]])
    track, frame, _ = video.queries("strided")
    assert (track.tolist(), frame.tolist()) == ([0, 0, 1, 0, 1], [0, 5, 5, 10, 10])
    assert read_video(tmp_path / "a.npz", square=False).clip.rgb.shape == (12, 96, 128, 3)
    jpeg = io.BytesIO()
    Image.new("RGB", (128, 96)).save(jpeg, "JPEG")
    arrays = moving()
    images = np.array([jpeg.getvalue()] * len(arrays.pop("video")))
    for key in ("video", "images_jpeg_bytes"):
        write(tmp_path / "a.npz", {**arrays, key: images})
        assert read_video(tmp_path / "a.npz").clip.rgb.shape == (12, 256, 256, 3)


def test_queries_alone_are_answered_as_together(tmp_path: Path) -> None:
    write(tmp_path / "a.npz", moving())
    video = read_video(tmp_path / "a.npz")
    _, frame, uv_px = video.queries("strided")
    together = follow(LucasKanade(), video.clip, frame, uv_px, both_ways=True)
    alone = follow(LucasKanade(), video.clip, frame, uv_px, both_ways=True, alone=True)
    for key, answers in together.items():
        np.testing.assert_array_equal(alone[key], answers)
    assert np.isfinite(together["uv_px"]).all()


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"video": None}, "images_jpeg_bytes"),
        ({"points": None}, "points"),
        ({"video": np.zeros((12, 8, 8), np.uint8)}, r"video \[T, H, W, 3\] of uint8, got \[12, 8, 8\]"),
        ({"video": np.zeros((12, 8, 8, 3))}, "uint8, got .* of float64"),
        ({"points": np.zeros((2, 11, 2))}, r"points of shape \['N', 12, 2\], got \[2, 11, 2\]"),
        ({"occluded": np.array([["no"] * 12] * 2)}, "occluded of shape .* of <U2"),
        ({"occluded": np.array([[None] * 12] * 2)}, "allow_pickle=False"),
        ({"occluded": np.zeros((2, 12), bool)}, "all of them finite"),
        ({"occluded": np.ones((2, 12), bool)}, "expected visible points"),
        ({"video": None, "images_jpeg_bytes": np.array([b"no jpeg"] * 12)}, "cannot identify image"),
        ({"tracks_XYZ": np.ones((12, 2, 3))}, "visibility"),
        *(
            ({"tracks_XYZ": np.ones((12, 2, 3)), "visibility": np.ones((12, 2)), **more}, match)
            for more, match in (
                ({"queries_xyt": np.array([[1, 1, 12]] * 2)}, "queries_xyt in frames below 12, got 12"),
                ({"queries_xyt": np.zeros((2, 3)), "fx_fy_cx_cy": np.zeros(4)}, "camera: .* fx, fy"),
                ({"queries_xyt": np.zeros((2, 3)), "fx_fy_cx_cy": np.full(4, 99), "depth_m": np.ones(3)}, "depth_m"),
            )
        ),
    ],
)
def test_what_is_no_video(tmp_path: Path, changes: dict[str, np.ndarray | None], match: str) -> None:
    arrays = {key: value for key, value in {**moving(), **changes}.items() if value is not None}
    write(tmp_path / "wrong.npz", arrays)
    with pytest.raises(InputError, match=f"wrong.npz: .*{match}"):
        read_video(tmp_path / "wrong.npz")


def test_files_that_are_torn_or_missing(tmp_path: Path) -> None:
    write(tmp_path / "whole.npz", moving())
    (tmp_path / "torn.npz").write_bytes((tmp_path / "whole.npz").read_bytes()[:5000])
    for name in ("torn", "none"):
        with pytest.raises(InputError, match=f"{name}.npz"):
            read_video(tmp_path / f"{name}.npz")


def test_command_on_takes_and_videos(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store, data, out = tmp_path / "takes", tmp_path / "small", tmp_path / "small.json"
    TakeStore(store).write(make_take(frames=11, views=2, size=(96, 80), name="panels"))
    assert main(["data", "export", str(store), "--out", str(data / "simulated"), "--depth"]) == 0
    write(data / "moving.npz", moving())
    command = ["bench", "tapvid", "--data", str(data), "--trackers", "hold-still", "lk", "--resamples", "20"]
    capsys.readouterr()
    assert main([*command, "--out", str(out)]) == 0
    printed, raw = capsys.readouterr().out, json.loads(out.read_text())
    by_row = {(row["of"], row["tracker"]): row for row in raw["rows"]}
    flat, space = "2D, first", "3D, first, scale: median"
    assert list(by_row) == [(flat, "hold-still"), (flat, "lk"), (space, "hold-still"), (space, "lk")]
    assert [by_row[of, "lk"]["units"] for of in (flat, space)] == [3, 2]  # only takes have depth
    assert by_row[flat, "lk"]["targets"] == 8
    for row in raw["rows"]:
        measure = row["measures"]["average_jaccard"]
        assert measure["low"] <= measure["mean"] <= measure["high"]
        assert re.search(rf"{100 * measure['mean']:.1f}\b", printed)
    single = {(row["of"], row["tracker"]): row["measures"] for row in raw["single"]}
    assert single[f"moving, {flat}", "lk"]["pts_within_4"] == 1.0
    assert single[f"moving, {flat}", "lk"]["survival"] == 1.0
    assert single[f"moving, {flat}", "lk"]["redetection"] > 0.9
    assert single[f"moving, {flat}", "hold-still"]["pts_within_4"] < 0.3
    # Asked for in later frames too, a tracker follows the reversed clip.
    assert main([*command, "--queries", "strided", "--scaling", "none", "--out", str(out)]) == 0
    raw = json.loads(out.read_text())
    single = {(row["of"], row["tracker"]): row["measures"] for row in raw["single"]}
    assert single["moving, 2D, strided", "lk"]["pts_within_4"] == 1.0
    assert {row["of"] for row in raw["rows"]} == {"2D, strided", "3D, strided, scale: none"}
    assert not out.with_suffix(".parts").exists()


def test_answers_are_kept_where_a_later_video_is_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(tmp_path / "a.npz", moving())
    (tmp_path / "b.npz").write_bytes(b"torn")
    command = ["bench", "tapvid", "--data", str(tmp_path), "--trackers", "lk", "--out", str(tmp_path / "out.json")]
    assert main(command) == 2
    assert "b.npz" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "out.parts").iterdir()] == ["a.lk.colours.npz"]


@pytest.mark.parametrize(
    ("arguments", "match"),
    [((), "expected .npz files"), (("--resamples", "0"), "resamples >= 1"), (("--out", "results"), "--out FILE.json")],
)
def test_command_errors(tmp_path: Path, arguments: tuple[str, ...], match: str, capsys: pytest.CaptureFixture) -> None:
    assert main(["bench", "tapvid", "--data", str(tmp_path), "--trackers", "lk", *arguments]) == 2
    assert match in capsys.readouterr().err
