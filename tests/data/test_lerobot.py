"""LeRobot v3: datasets as lerobot writes them, what this project exports, and what is refused."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import ExifTags, Image

from quest.data.camera_file import CameraFile, write_camera
from quest.data.frame_source import Parts
from quest.data.lerobot import DepthRange
from quest.data.lerobot_export import Episode, export_lerobot
from quest.data.recording import open_recording, read_recording
from quest.data.video import play_video, write_video
from quest.errors import InputError, RecordingError
from quest.types import Camera, Take
from tests.synthetic import make_take

FRAMES = 12
CAMERA = Camera(60.0, 61.0, 32.0, 24.0, 64, 48)
KEY, DEPTH_KEY = "observation.images.view_0", "observation.images.view_0_depth"


@pytest.fixture(scope="module")
def takes() -> list[Take]:
    return [make_take(frames=FRAMES + k, views=2, entities=3 - k, size=(64, 48), seed=k) for k in range(2)]


@pytest.fixture(scope="module")
def dataset(takes: list[Take], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lerobot") / "dataset"
    assert export_lerobot((Episode.of_take(take) for take in takes), folder) == 2
    return folder


def rows_of(folder: Path, pattern: str) -> list[dict[str, Any]]:
    tables = [pq.read_table(path) for path in sorted(folder.glob(pattern))]
    return pa.concat_tables(tables).to_pylist()


@pytest.mark.parametrize(("episode", "view"), [(0, 1), (1, 0)])
def test_round_trip(dataset: Path, takes: list[Take], episode: int, view: int):
    clip = takes[episode].views[view].clip
    source = open_recording(dataset, parts=Parts(episode=episode, camera_key=f"view_{view}"))
    assert (source.length, source.flags) == (FRAMES + episode, ())
    assert source.name == f"dataset-{episode:06d}-view_{view}"
    found = source.clip()
    assert found.camera == clip.camera
    np.testing.assert_array_equal(found.stamp_s, clip.stamp_s)
    np.testing.assert_allclose(found.cam_from_world, clip.cam_from_world, atol=1e-12)
    assert found.depth_m is not None
    assert clip.depth_m is not None
    np.testing.assert_array_equal(found.depth_m > 0, clip.depth_m > 0)
    np.testing.assert_allclose(found.depth_m, clip.depth_m, atol=2e-3)
    assert np.abs((found.rgb.astype(int) - clip.rgb) @ [0.299, 0.587, 0.114]).mean() < 4


def test_what_the_loader_of_lerobot_asks_for(dataset: Path, takes: list[Take]):
    """The names and types that lerobot 0.6.2 reads: DatasetInfo, load_episodes, load_tasks, DatasetReader."""
    info = json.loads((dataset / "meta" / "info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (2, 2 * FRAMES + 1, 1)
    assert isinstance(info["fps"], int)
    assert info["splits"] == {"train": "0:2"}
    needed = {"timestamp": "float32"} | dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), "int64")
    for key, dtype in needed.items():
        assert info["features"][key] == {"dtype": dtype, "shape": [1], "names": None}
    assert not [key for key in info["features"] if "/" in key]
    depth = info["features"][DEPTH_KEY]
    assert depth["shape"] == [48, 64, 1]
    assert depth["info"]["is_depth_map"]
    assert {f"video.{name}" for name in ("depth_min", "depth_max", "shift", "use_log")} <= set(depth["info"])
    assert not info["features"][KEY]["info"]["is_depth_map"]

    episodes = rows_of(dataset, "meta/episodes/*/*.parquet")
    videos = [key for key, feature in info["features"].items() if feature["dtype"] == "video"]
    assert len(videos) == 4
    for index, row in enumerate(episodes):
        assert (row["episode_index"], row["length"]) == (index, FRAMES + index)
        assert row["tasks"] == [f"open {takes[index].info.category}"]
        assert row["dataset_from_index"] == index * FRAMES
        assert row["dataset_to_index"] == row["dataset_from_index"] + row["length"]
        data = info["data_path"].format(chunk_index=row["data/chunk_index"], file_index=row["data/file_index"])
        table = pq.read_table(dataset / data)
        assert table.num_rows == row["length"]
        for key in videos:
            place = {name: row[f"videos/{key}/{name}"] for name in ("chunk_index", "file_index")}
            path = dataset / info["video_path"].format(video_key=key, **place)
            begin = row[f"videos/{key}/from_timestamp"]
            assert row[f"videos/{key}/to_timestamp"] == pytest.approx(begin + row["length"] / info["fps"])
            pixel_format = "gray12le" if "depth" in key else "rgb24"
            times = [time_s for _, time_s in play_video(path, pixel_format=pixel_format)]
            # decode_video_frames allows 1e-4 s
            np.testing.assert_allclose(times, begin + table["timestamp"].to_numpy(), atol=1e-4)
    index = [row["index"] for row in rows_of(dataset, "data/*/*.parquet")]
    assert index == list(range(2 * FRAMES + 1))


def test_columns_have_the_types_of_their_features(dataset: Path):
    info = json.loads((dataset / "meta" / "info.json").read_text())
    schema = pq.read_schema(next(dataset.glob("data/*/*.parquet")))
    stored = {key: feature for key, feature in info["features"].items() if feature["dtype"] != "video"}
    assert set(schema.names) == set(stored)
    for key, feature in stored.items():
        element = pa.bool_() if feature["dtype"] == "bool" else pa.type_for_alias(feature["dtype"])
        (size,) = feature["shape"]
        assert schema.field(key).type == (element if size == 1 else pa.list_(element, size)), key
        assert feature["names"] is None or len(feature["names"]) == size


def test_tasks_are_indexed_by_their_words(dataset: Path):
    """pandas restores the index from the schema's metadata; it is not needed here to check what it reads."""
    table = pq.read_table(dataset / "meta" / "tasks.parquet")
    words = json.loads(table.schema.metadata[b"pandas"])
    assert words["index_columns"] == ["task"]
    assert [column["name"] for column in words["columns"]] == ["task_index", "task"]
    assert table["task_index"].to_pylist() == [0]


def test_statistics(dataset: Path, takes: list[Take]):
    stats = json.loads((dataset / "meta" / "stats.json").read_text())
    state = np.concatenate([np.pad(t.joint_position, ((0, 0), (0, 3 - t.joint_position.shape[1]))) for t in takes])
    found = stats["observation.state"]
    np.testing.assert_allclose(found["mean"], state.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(found["std"], state.std(axis=0), atol=1e-6)
    np.testing.assert_allclose(found["max"], state.max(axis=0), atol=1e-6)
    assert found["count"] == [2 * FRAMES + 1]
    for key, channels in ((KEY, 3), (DEPTH_KEY, 1)):
        for name, value in stats[key].items():
            assert np.shape(value) == ((1,) if name == "count" else (channels, 1, 1)), (key, name)
    assert 0 <= np.min(stats[KEY]["min"]) < np.max(stats[KEY]["max"]) <= 1
    row = rows_of(dataset, "meta/episodes/*/*.parquet")[0]
    assert {f"stats/{key}/{name}" for key in stats for name in stats[key]} <= set(row)


def test_truth_is_in_the_rows(dataset: Path, takes: list[Take]):
    rows = [row for row in rows_of(dataset, "data/*/*.parquet") if row["episode_index"] == 1]
    take = takes[1]
    places = 3
    uv_px = np.array([row["observation.tracks.view_1.uv_px"] for row in rows]).reshape(-1, places, 2)
    np.testing.assert_array_equal(uv_px[:, :2], take.views[1].uv_px)
    assert np.isnan(uv_px[:, 2]).all(), "places that nobody has are empty"
    point = np.array([row["observation.tracks.view_0.point_world"] for row in rows]).reshape(-1, places, 3)
    np.testing.assert_array_equal(point[:, :2], take.point_world)
    visible = np.array([row["observation.tracks.view_0.visible"] for row in rows])
    np.testing.assert_array_equal(visible[:, :2], take.views[0].visible)
    assert not visible[:, 2].any()
    episode = rows_of(dataset, "meta/episodes/*/*.parquet")[1]
    assert episode["quest/entities"] == [entity.name for entity in take.info.entities]


def test_export_refuses_what_does_not_fit(takes: list[Take], dataset: Path, tmp_path: Path):
    with pytest.raises(InputError, match="not an empty folder"):
        export_lerobot([], dataset)
    with pytest.raises(InputError, match="expected at least one episode"):
        export_lerobot([], tmp_path / "none")
    few = [Episode.of_take(take) for take in reversed(takes)]
    with pytest.raises(InputError, match=r"episode 1: 3 joints and 3 entities do not fit 2 and 2 places"):
        export_lerobot(few, tmp_path / "few")
    flat = replace(few[0].views["view_0"], depth_m=None)
    with pytest.raises(InputError, match=r"episode 1: views .* expected those of the first episode"):
        export_lerobot([few[0], replace(few[0], views=few[0].views | {"view_0": flat})], tmp_path / "flat")
    with pytest.raises(InputError, match="views named by letters"):
        export_lerobot([Episode({"front/left": flat}, "look")], tmp_path / "name")
    assert list(tmp_path.iterdir()) == [], "all or nothing"


def foreign(folder: Path, *, keep: str = "video") -> tuple[Path, np.ndarray, np.ndarray]:
    """A dataset as lerobot writes one: several episodes in one file and one video, no intrinsics, no poses."""
    rng = np.random.default_rng(1)
    coarse = rng.integers(0, 256, (20, 6, 8, 3)).astype(np.uint8)
    rgb = coarse.repeat(8, axis=1).repeat(8, axis=2)
    depth_mm = rng.integers(500, 3000, (20, 48, 64)).astype(np.uint16)
    key = "observation.images.top"
    features: dict[str, Any] = {key: {"dtype": keep, "shape": [48, 64, 3], "names": ["height", "width", "channels"]}}
    episode = [0] * 8 + [1] * 12
    frame = [*range(8), *range(12)]
    columns: dict[str, Any] = {
        "timestamp": pa.array([t / 10 for t in frame], pa.float32()),
        "frame_index": frame,
        "episode_index": episode,
        "index": list(range(20)),
        "task_index": [0] * 20,
    }
    row: dict[str, Any] = {"data/chunk_index": 0, "data/file_index": 0}
    if keep == "video":
        write_video(folder / f"videos/{key}/chunk-000/file-000.mp4", rgb, frames_per_s=10, crf=4, keyframe_every=5)
        row |= {f"videos/{key}/chunk_index": 0, f"videos/{key}/file_index": 0}
    else:
        features[key + "_depth"] = {"dtype": "image", "shape": [48, 64, 1], "info": {"is_depth_map": True}}
        for name, pictures, kind in ((key, rgb, "PNG"), (key + "_depth", depth_mm, "TIFF")):
            columns[name] = [{"bytes": encoded(picture, kind), "path": "frame"} for picture in pictures]
    rows = []
    for number, (begin, end) in enumerate(((0, 8), (8, 20))):
        own = row | {"episode_index": number, "tasks": ["look"], "length": end - begin}
        own |= {"dataset_from_index": begin, "dataset_to_index": end, "stats/index/mean": [0.0]}
        if keep == "video":
            own |= {f"videos/{key}/from_timestamp": begin / 10, f"videos/{key}/to_timestamp": end / 10}
        rows.append(own)
    for path, table in (
        ("data/chunk-000/file-000.parquet", pa.table(columns)),
        ("meta/episodes/chunk-000/file-000.parquet", pa.Table.from_pylist(rows)),
    ):
        (folder / path).parent.mkdir(parents=True)
        pq.write_table(table, folder / path)
    info = {
        "codebase_version": "v3.0",
        "fps": 10,
        "features": features,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
    }
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    return folder, rgb, depth_mm


def encoded(picture: np.ndarray, kind: str) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format=kind)
    return buffer.getvalue()


def test_episodes_that_share_a_video(tmp_path: Path):
    folder, rgb, _ = foreign(tmp_path / "set")
    for episode, expected in enumerate((rgb[:8], rgb[8:])):
        source = open_recording(folder, camera=CAMERA, parts=Parts(episode=episode))
        found = source.clip()
        assert len(found) == len(expected)
        assert np.abs(found.rgb.astype(int) - expected).mean() < 8
        np.testing.assert_allclose(found.stamp_s, np.arange(len(expected)) / 10, atol=1e-6)
        assert source.flags == (
            "no depth feature beside observation.images.top: colours only",
            "the dataset has no camera poses: the world is the camera",
        )


def edit_rows(folder: Path, **columns: list[Any]) -> None:
    path = next(folder.glob("data/*/*.parquet"))
    table = pq.read_table(path)
    for name, values in columns.items():
        table = table.set_column(table.column_names.index(name), name, pa.array(values))
    pq.write_table(table, path)


def test_pictures_in_the_rows_and_their_units(dataset: Path, tmp_path: Path):
    folder, rgb, depth_mm = foreign(tmp_path / "set", keep="image")
    write_camera(CameraFile(CAMERA, depth_scale_m=5e-4), tmp_path / "camera.json")
    cases: list[tuple[dict[str, Any], float]] = [
        ({"camera": CAMERA}, 1e-3),
        ({"camera": CAMERA, "depth_scale_m": 2e-3}, 2e-3),
        ({"camera": tmp_path / "camera.json"}, 5e-4),
    ]
    for options, unit_m in cases:
        found = read_recording(folder, parts=Parts(episode=1), **options)
        np.testing.assert_array_equal(found.rgb, rgb[8:])
        assert found.depth_m is not None
        np.testing.assert_allclose(found.depth_m, depth_mm[8:] * unit_m, atol=1e-6)
    with pytest.raises(RecordingError, match="depth_scale_m is -1, expected a positive number"):
        open_recording(folder, camera=CAMERA, depth_scale_m=-1)
    with pytest.raises(RecordingError, match=r"with depth_scale_m = 1, .*depth_scale_m = 0\.001 would give"):
        read_recording(folder, camera=CAMERA, depth_scale_m=1)
    with pytest.raises(RecordingError, match="is for a folder or video, and this is a LeRobot v3 dataset"):
        open_recording(folder, camera=CAMERA, depth=tmp_path)
    with pytest.raises(RecordingError, match=r"view_0_depth is a video, whose metres info\.json gives"):
        open_recording(dataset, depth_scale_m=1e-3)


def test_deep_and_turned_colours_in_the_rows(tmp_path: Path):
    folder, rgb, _ = foreign(tmp_path / "set", keep="image")
    key = "observation.images.top"
    grey = rgb[..., 0].astype(np.uint16) * 256 + 77
    edit_rows(folder, **{key: [{"bytes": encoded(picture, "PNG"), "path": "frame"} for picture in grey]})
    np.testing.assert_array_equal(read_recording(folder, camera=CAMERA).rgb[..., 1], rgb[:8, ..., 0])
    buffer, exif = io.BytesIO(), Image.Exif()
    exif[ExifTags.Base.Orientation] = 3
    Image.fromarray(rgb[0]).save(buffer, format="PNG", exif=exif)
    edit_rows(folder, **{key: [{"bytes": buffer.getvalue(), "path": "frame"}] * 20})
    with pytest.raises(RecordingError, match=r"a picture of observation\.images\.top .*depth is not turned with them"):
        read_recording(folder, camera=CAMERA)
    info = json.loads((folder / "meta" / "info.json").read_text())
    edit_info(folder, features={key: info["features"][key]})
    np.testing.assert_array_equal(read_recording(folder, camera=CAMERA).rgb[0], rgb[0, ::-1, ::-1])


def test_damaged_pictures_in_the_rows(tmp_path: Path):
    folder, _, _ = foreign(tmp_path / "set", keep="image")
    path = next(folder.glob("data/*/*.parquet"))
    column = pq.read_metadata(path).row_group(0).column(5)
    assert column.path_in_schema.startswith("observation.images.top.bytes")
    data, begin = bytearray(path.read_bytes()), column.dictionary_page_offset or column.data_page_offset
    data[begin : begin + 400] = b"\xff" * 400
    path.write_bytes(data)
    with pytest.raises(RecordingError, match=r"(?s)file-000\.parquet: cannot be read.*copy it again"):
        read_recording(folder, camera=CAMERA)


def test_depth_codes():
    depth_m = np.array([0.0, 0.02, 1.0, 9.9, 12.0], np.float32)
    for scale in (DepthRange(), DepthRange(use_log=False), DepthRange(0.2, 4.0, 0.0)):
        found = scale.depth(scale.codes(depth_m))
        assert found[0] == found[4] == 0
        np.testing.assert_allclose(found[2], 1.0, atol=2e-3)
    # quantize_depth of lerobot 0.6.2 at its defaults: rint(4095 (ln(d + 3.5) - ln 3.51) / (ln 13.5 - ln 3.51))
    assert DepthRange().codes(np.array([1.0], np.float32))[0] == 755
    with pytest.raises(InputError, match="depth range"):
        DepthRange(2.0, 1.0)


def edit_info(folder: Path, **fields: Any) -> None:
    path = folder / "meta" / "info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | fields))


def cut_video(folder: Path) -> None:
    path = next(folder.glob("videos/*/*/*.mp4"))
    frames = [picture for picture, _ in play_video(path)]
    write_video(path, frames[:6], frames_per_s=10)


def tear(folder: Path, pattern: str) -> None:
    path = next(folder.glob(pattern))
    path.write_bytes(path.read_bytes()[:40])


BAD: dict[str, tuple[Callable[[Path], object], dict[str, Any], str]] = {
    "older format": (lambda f: edit_info(f, codebase_version="v2.1"), {}, "format v2.1, expected v3.0; convert it"),
    "no JSON": (lambda f: (f / "meta/info.json").write_text("{"), {}, "info.json: cannot be read"),
    "another JSON": (lambda f: (f / "meta/info.json").write_text("{}"), {}, "lacks codebase_version, features"),
    "no such episode": (lambda f: None, {"episode": 7}, "no episode 7; it has 2, counted from 0"),
    "no such camera": (lambda f: None, {"camera_key": "wrist"}, "no camera 'wrist'; its cameras are .*images.top"),
    "no images": (lambda f: edit_info(f, features={"index": {"dtype": "int64"}}), {}, "no feature of images"),
    "torn rows": (lambda f: tear(f, "data/*/*.parquet"), {}, "file-000.parquet: cannot be read"),
    "torn episodes": (lambda f: tear(f, "meta/episodes/*/*.parquet"), {}, "file-000.parquet: cannot be read"),
    "torn video": (lambda f: tear(f, "videos/*/*/*.mp4"), {}, "cannot be decoded"),
    "short video": (cut_video, {}, "has 6 of the 8 frames of episode 0; the file is corrupt"),
    "a path of code": (lambda f: edit_info(f, data_path="{chunk_index.__class__}/x"), {}, "expected a path below"),
    "a path of gigabytes": (lambda f: edit_info(f, data_path="{chunk_index:2000000000d}"), {}, "expected a path below"),
    "a path that leads out": (lambda f: edit_info(f, data_path="../{file_index:03d}"), {}, "expected a path below"),
    "an unknown field": (lambda f: edit_info(f, data_path="{episode}"), {}, "expected fields"),
    "no rate": (lambda f: edit_info(f, fps=0), {}, "fps: expected frames per second"),
    "features in a list": (lambda f: edit_info(f, features=[1]), {}, "features: expected an object"),
    "no video": (lambda f: next(f.glob("videos/*/*/*.mp4")).unlink(), {}, "no such file"),
}  # fmt: skip


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return foreign(tmp_path_factory.mktemp("foreign") / "set")[0]


@pytest.mark.parametrize("how", BAD)
def test_what_is_refused(how: str, whole: Path, tmp_path: Path):
    folder = Path(shutil.copytree(whole, tmp_path / "set"))
    spoil, parts, message = BAD[how]
    spoil(folder)
    with pytest.raises(RecordingError, match=message):
        read_recording(folder, camera=CAMERA, parts=Parts(**parts))


def test_intrinsics_are_guessed_or_asked_for(whole: Path, tmp_path: Path):
    assert any("guessed a focal length of 64 px" in flag for flag in open_recording(whole).flags)
    assert open_recording(whole, fov_deg=90).camera.fx == pytest.approx(32)
    with pytest.raises(RecordingError, match=r"frames|colours"):
        read_recording(whole, camera=Camera(60, 60, 30, 30, 60, 60))
    with_depth, _, _ = foreign(tmp_path / "images", keep="image")
    with pytest.raises(RecordingError, match=r"depth but no camera.*--camera FILE.*--fov"):
        open_recording(with_depth)


def test_every_episode_has_its_own_intrinsics(takes: list[Take], tmp_path: Path):
    first, second = (Episode({"front": take.views[0].clip, "side": take.views[1].clip}, "look") for take in takes)
    clip = second.views["front"]
    other = replace(clip, camera=replace(clip.camera, fx=1.5 * clip.camera.fx, fy=1.5 * clip.camera.fy))
    export_lerobot([first, replace(second, views=second.views | {"front": other})], tmp_path / "set")
    for index, episode in enumerate((first.views["front"], other)):
        parts = Parts(episode=index, camera_key="front")
        assert open_recording(tmp_path / "set", parts=parts).camera == episode.camera
    features = json.loads((tmp_path / "set" / "meta" / "info.json").read_text())["features"]
    assert "quest.camera" not in features["observation.images.front"]["info"], "it would hold for one episode only"
    assert "quest.camera" in features["observation.images.side"]["info"]


def test_datasets_with_intrinsics_in_the_feature_alone(dataset: Path, takes: list[Take], tmp_path: Path):
    """As they were written before there was a column for them."""
    folder = Path(shutil.copytree(dataset, tmp_path / "set"))
    path = next(folder.glob("meta/episodes/*/*.parquet"))
    table = pq.read_table(path)
    pq.write_table(table.drop_columns([name for name in table.column_names if name.startswith("quest/camera")]), path)
    source = open_recording(folder)
    assert source.camera == takes[0].views[0].clip.camera
    assert source.flags == (
        "camera observation.images.view_0 of observation.images.view_0, observation.images.view_1; choose another with "
        "--camera-key",
    )
