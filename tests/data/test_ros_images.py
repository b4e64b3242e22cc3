"""Pictures in ROS messages: every encoding of colours and depth, as plain and as compressed images."""

from __future__ import annotations

import contextlib
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from quest.data.ros_frames import NO_DEPTH, NO_POSE
from quest.data.ros_images import decode_rvl
from tests.data.bags import (
    BEGIN,
    COLOUR,
    DEPTH,
    DEPTH_MM,
    IMAGE,
    RGB,
    colours,
    compressed,
    frames_of,
    image,
    info,
    png,
    rvl,
    write_mcap,
)

BAYER = {"rggb": ((0, 1), (1, 2)), "bggr": ((2, 1), (1, 0)), "gbrg": ((1, 2), (0, 1)), "grbg": ((1, 0), (2, 1))}


def mosaic(rgb: np.ndarray, pattern: str) -> np.ndarray:
    y, x = np.mgrid[: rgb.shape[0], : rgb.shape[1]]
    channel = np.array(BAYER[pattern])[y % 2, x % 2]
    return np.take_along_axis(rgb, channel[..., None], axis=-1)[..., 0]


FLAT = np.tile(np.array([200, 100, 40], np.uint8), (24, 32, 1))
ALPHA = np.full((24, 32, 1), 77, np.uint8)
PICTURES: dict[str, tuple[np.ndarray, np.ndarray]] = {
    "rgb8": (RGB[0], RGB[0]),
    "bgr8": (RGB[0][..., ::-1], RGB[0]),
    "8UC3": (RGB[0][..., ::-1], RGB[0]),
    "rgba8": (np.concatenate((RGB[0], ALPHA), -1), RGB[0]),
    "bgra8": (np.concatenate((RGB[0][..., ::-1], ALPHA), -1), RGB[0]),
    "mono8": (RGB[0][..., 0], np.repeat(RGB[0][..., :1], 3, -1)),
    "rgb16": (RGB[0].astype(np.uint16) * 257, RGB[0]),
    **{f"bayer_{name}8": (mosaic(FLAT, name), FLAT) for name in BAYER},
    "bayer_rggb16": (mosaic(FLAT, "rggb").astype(np.uint16) * 257, FLAT),
}


@pytest.mark.parametrize("encoding", PICTURES)
def test_encodings_of_colours(encoding: str, tmp_path: Path):
    pixels, expected = PICTURES[encoding]
    for big, pad in ((False, 0), (True, 0), (False, 6)):
        sent = image(pixels, encoding, BEGIN, pad=pad, big_endian=big)
        frames, flags = frames_of(write_mcap(tmp_path / "bag.mcap", [info(), (COLOUR, IMAGE, sent, BEGIN)]))
        np.testing.assert_array_equal(frames[0].rgb, expected)
        assert frames[0].depth_m is None
        assert flags == (NO_POSE, NO_DEPTH)


def test_yuv_of_one_colour(tmp_path: Path):
    grey = np.full((24, 32, 2), 128, np.uint8)
    for encoding, luma in (("yuv422", 1), ("yuyv", 0)):
        grey[..., luma] = 235
        sent = (COLOUR, IMAGE, image(grey, encoding, BEGIN), BEGIN)
        frames, _ = frames_of(write_mcap(tmp_path / "bag.mcap", [info(), sent]))
        assert frames[0].rgb.min() > 250
        grey[..., luma] = 128


@pytest.mark.parametrize(("suffix", "kind"), [(".jpg", "rgb8; jpeg compressed bgr8"), (".png", "png")])
def test_compressed_colours(suffix: str, kind: str, tmp_path: Path):
    smooth = cv2.GaussianBlur(RGB[0], (0, 0), 5)
    data = cv2.imencode(suffix, smooth[..., ::-1])[1].tobytes()
    topic = COLOUR + "/compressed"
    sent = (topic, "sensor_msgs/msg/CompressedImage", compressed(data, kind, BEGIN), BEGIN)
    frames, _ = frames_of(write_mcap(tmp_path / "bag.mcap", [info(), sent]))
    assert np.abs(frames[0].rgb.astype(int) - smooth).max() <= (0 if suffix == ".png" else 6)


def depth_messages() -> dict[str, tuple[str, str, dict[str, Any]]]:
    metres, a, b = (DEPTH_MM[0] / 1000).astype(np.float32), 10_000.0, -0.5
    header, kind = struct.Struct("<iff"), "sensor_msgs/msg/CompressedImage"
    units = np.rint(a / metres + b).astype(np.uint16)
    plain, quantised = header.pack(0, 0.0, 0.0), header.pack(0, a, b)
    images = {
        "16UC1": image(DEPTH_MM[0], "16UC1", BEGIN, pad=4),
        "16UC1 big": image(DEPTH_MM[0], "16UC1", BEGIN, big_endian=True),
        "mono16": image(DEPTH_MM[0], "mono16", BEGIN),
        "32FC1": image(metres, "32FC1", BEGIN, pad=8),
        "32FC1 big": image(metres, "32FC1", BEGIN, big_endian=True),
    }
    packed = {
        "16UC1; compressedDepth png": plain + png(DEPTH_MM[0]),
        "32FC1; compressedDepth png": quantised + png(units),
        "16UC1; compressedDepth rvl": plain + rvl(DEPTH_MM[0]),
        "32FC1; compressedDepth rvl": quantised + rvl(units),
        "16UC1; png compressed ": png(DEPTH_MM[0]),
    }
    found = {name: (DEPTH, IMAGE, fields) for name, fields in images.items()}
    for name, data in packed.items():
        transport = "compressedDepth" if "compressedDepth" in name else "compressed"
        found[name] = f"{DEPTH}/{transport}", kind, compressed(data, name, BEGIN)
    return found


@pytest.mark.parametrize("how", depth_messages())
def test_encodings_of_depth(how: str, tmp_path: Path):
    topic, kind, fields = depth_messages()[how]
    frames, _ = frames_of(write_mcap(tmp_path / "bag.mcap", [info(), colours(0), (topic, kind, fields, BEGIN)]))
    assert frames[0].depth_m is not None
    np.testing.assert_allclose(frames[0].depth_m, DEPTH_MM[0] / 1000, atol=2e-3 if "32FC1" in how else 1e-6)


def test_missing_depth_is_zero(tmp_path: Path):
    metres = (DEPTH_MM[0] / 1000).astype(np.float32)
    metres[0, :3] = [np.nan, np.inf, -1]
    sent = (DEPTH, IMAGE, image(metres, "32FC1", BEGIN), BEGIN)
    frames, _ = frames_of(write_mcap(tmp_path / "bag.mcap", [info(), colours(0), sent]))
    assert frames[0].depth_m is not None
    assert (frames[0].depth_m[0, :3] == 0).all()


@pytest.mark.parametrize("holes", [0.0, 0.4, 1.0])
def test_rvl_of_any_depth(holes: float):
    rng = np.random.default_rng(3)
    picture = rng.integers(0, 2**16, (17, 23)).astype(np.uint16) * (rng.random((17, 23)) >= holes)
    np.testing.assert_array_equal(decode_rvl(rvl(picture)), picture)
    for end in range(0, len(rvl(picture)) - 8, 12):  # a cut one may end in zeros that were never written
        with contextlib.suppress(ValueError):
            assert decode_rvl(rvl(picture)[:end]).shape == picture.shape


def test_rvl_that_claims_to_be_huge():
    with pytest.raises(ValueError, match="4294967295"):
        decode_rvl(b"\xff" * 64)
