"""Image files as colours: deep grey, and what EXIF says of their orientation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image

from quest.data.pictures import colours_of
from quest.data.recording import open_recording, read_recording
from quest.errors import RecordingError
from quest.types import Camera

RGB = np.random.default_rng(0).integers(0, 256, (48, 64, 3)).astype(np.uint8)
UPRIGHT, ACROSS = Camera(60.0, 60.0, 24.0, 32.0, 48, 64), Camera(60.0, 60.0, 32.0, 24.0, 64, 48)
TURNS = {1: RGB, 2: RGB[:, ::-1], 3: RGB[::-1, ::-1], 6: np.rot90(RGB, -1), 8: np.rot90(RGB)}


def save(path: Path, orientation: int) -> None:
    path.parent.mkdir(exist_ok=True)
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    Image.fromarray(RGB).save(path, exif=exif)


@pytest.mark.parametrize("orientation", TURNS)
def test_images_are_turned_upright(orientation: int, tmp_path: Path):
    save(tmp_path / "rgb" / "0.png", orientation)
    source = open_recording(tmp_path / "rgb", camera=UPRIGHT if orientation > 4 else ACROSS)
    np.testing.assert_array_equal(source.clip().rgb[0], TURNS[orientation])


def test_depth_beside_turned_images_is_refused(tmp_path: Path):
    save(tmp_path / "rgb" / "0.png", 1)
    save(tmp_path / "rgb" / "1.png", 3)
    (tmp_path / "depth").mkdir()
    for t in range(2):
        Image.fromarray(np.full((48, 64), 2000, np.uint16)).save(tmp_path / "depth" / f"{t}.png")
    with pytest.raises(RecordingError, match=r"1\.png: EXIF .* their depth is not turned with them"):
        read_recording(tmp_path, camera=ACROSS)
    save(tmp_path / "rgb" / "1.png", 1)
    assert len(read_recording(tmp_path, camera=ACROSS)) == 2


def test_depth_goes_with_the_colours_of_its_name(tmp_path: Path):
    (tmp_path / "depth").mkdir()
    for t in range(4):
        save(tmp_path / "rgb" / f"{t}.png", 1)
        Image.fromarray(np.full((48, 64), 1000 + t, np.uint16)).save(tmp_path / "depth" / f"{t}.png")
    (tmp_path / "rgb" / "1.png").unlink()
    with pytest.raises(RecordingError, match="4 depth images for 3 colour frames, and 1 has no colours"):
        read_recording(tmp_path, camera=ACROSS)
    (tmp_path / "depth" / "2.png").unlink()
    with pytest.raises(RecordingError, match="3 depth images for 3 colour frames, and 1 has no colours"):
        read_recording(tmp_path, camera=ACROSS)
    for path in (tmp_path / "depth").iterdir():  # names of another kind: by order
        path.rename(path.with_name(f"depth{path.name}"))
    assert len(read_recording(tmp_path, camera=ACROSS)) == 3
    for path in (tmp_path / "depth").iterdir():
        path.rename(path.with_suffix(".dat"))
    with pytest.raises(RecordingError, match=r"expected 16-bit PNG images, got files such as depth0\.dat"):
        read_recording(tmp_path, camera=ACROSS)


def test_names_that_are_times_are_in_their_order(tmp_path: Path):
    for level, name in enumerate(("10", "10.0667", "10.2", "10.5", "9.75")):
        Image.fromarray(np.full((48, 64, 3), level, np.uint8)).save(tmp_path / f"{name}.png")
    assert read_recording(tmp_path, camera=ACROSS).rgb[:, 0, 0, 0].tolist() == [4, 0, 1, 2, 3]


def test_deep_grey_keeps_its_higher_byte(tmp_path: Path):
    grey = np.random.default_rng(1).integers(0, 65536, (48, 64)).astype(np.uint16)
    Image.fromarray(grey).save(tmp_path / "0.png")
    found = read_recording(tmp_path, camera=ACROSS)
    np.testing.assert_array_equal(found.rgb[0], np.repeat((grey >> 8)[..., None], 3, axis=-1))


@pytest.mark.parametrize("kind", [np.float32, np.int32])
def test_pixels_of_no_known_white_are_refused(kind: type):
    with pytest.raises(RecordingError, match="image x: expected colours or grey of 8 or 16 bits, got mode"):
        colours_of(Image.fromarray(np.ones((4, 4), kind)), "image x")
