"""Pictures in ROS messages: ``sensor_msgs/Image``, ``CompressedImage`` and the depth that image_transport compresses.

Depth is compressed as PNG or as RVL. In RVL a picture is a row of runs: how many zeros, how many others, and of each of
these the difference from the one before. Numbers are written in groups of three bits, the lowest first, with a fourth
bit that says that more follow.

Reference: the message definitions of sensor_msgs; REP 118 (depth images: 16UC1 in millimetres, 32FC1 in metres);
``compressed_depth_image_transport`` for its header of twelve bytes; Wilson, "Fast lossless depth image compression",
ISS 2017.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, UInt8, UInt16

from quest.depth import clean_depth, metres
from quest.errors import RecordingError
from quest.untrusted import reading

DEPTH_ENCODINGS = ("16UC1", "32FC1", "mono16")
"""Encodings of depth; mono16 also occurs for infrared pictures."""

_MILLIMETRE_M = 1e-3
_HEADER = struct.Struct("<iff")
_RVL_SIZE = struct.Struct("<II")
_MOST_RVL_PIXELS = 2**24
_LONGEST = 11
"""Groups of three bits in a number of 32."""


@dataclass(frozen=True)
class _Layout:
    """How pixels lie in a message: element type, channels, and the conversion of their bytes to RGB."""

    dtype: str
    channels: int
    to_rgb: Callable[[np.ndarray], np.ndarray]


def _converted(code: str) -> Callable[[np.ndarray], np.ndarray]:
    return lambda image: np.asarray(cv2.cvtColor(image, getattr(cv2, f"COLOR_{code}")))


_RGB = _Layout("u1", 3, lambda image: image)
_BGR = _Layout("u1", 3, lambda image: image[..., ::-1])
_BGRA = _Layout("u1", 4, lambda image: image[..., 2::-1])
_GREY = _Layout("u1", 1, lambda image: np.repeat(image[..., None], 3, axis=-1))
_UYVY, _YUYV = (_Layout("u1", 2, _converted(f"YUV2RGB_{order}")) for order in ("UYVY", "YUY2"))
_BAYER = {pattern: _converted(f"Bayer{pattern.upper()}2RGB") for pattern in ("rggb", "bggr", "gbrg", "grbg")}
_COLOURS = {
    "rgb8": _RGB,
    "rgba8": replace(_RGB, channels=4, to_rgb=lambda image: image[..., :3]),
    "rgb16": replace(_RGB, dtype="u2"),
    "bgr16": replace(_BGR, dtype="u2"),
    **dict.fromkeys(("bgr8", "8UC3"), _BGR),
    **dict.fromkeys(("bgra8", "8UC4"), _BGRA),
    **dict.fromkeys(("mono8", "8UC1"), _GREY),
    **dict.fromkeys(("yuv422", "uyvy"), _UYVY),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), _YUYV),
    **{f"bayer_{pattern}8": _Layout("u1", 1, to_rgb) for pattern, to_rgb in _BAYER.items()},
    **{f"bayer_{pattern}16": _Layout("u2", 1, to_rgb) for pattern, to_rgb in _BAYER.items()},
}


def encoding_of(message: Any) -> str:
    """Encoding of an Image, or the format of a CompressedImage."""
    return str(message.encoding if hasattr(message, "encoding") else message.format)


def is_grey(message: Any) -> bool:
    """Whether a message's picture has no colour."""
    encoding = encoding_of(message)
    return encoding in ("mono8", "8UC1") or encoding.startswith("mono8;")


def is_depth(message: Any) -> bool:
    """Whether an Image or CompressedImage can be a picture of depth, by its encoding."""
    encoding = encoding_of(message)
    if hasattr(message, "encoding"):
        return encoding in DEPTH_ENCODINGS
    return "compressedDepth" in encoding or encoding.partition(";")[0].strip() in DEPTH_ENCODINGS


def header_ns(message: Any) -> int:
    """Time in a message's header in nanoseconds; 0 where nobody set it."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def unit_of(message: Any) -> float:
    """Metres per unit of a picture of depth, as REP 118 has it: millimetres in 16 bits, metres in floats."""
    return 1.0 if encoding_of(message).startswith("32FC1") else _MILLIMETRE_M


def rgb_of(message: Any, where: str) -> UInt8[np.ndarray, "H W 3"]:
    """Colours of an Image or CompressedImage.

    Raises:
        RecordingError: the picture is corrupt, or of an encoding that is not of colours.
    """
    if not hasattr(message, "encoding"):
        image = _decode(message.data, where, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        return np.ascontiguousarray(image[..., ::-1])
    layout = _COLOURS.get(message.encoding)
    if layout is None:
        raise RecordingError(
            f"{where}: encoding {message.encoding!r} is not one of colours; known are {', '.join(_COLOURS)}; name "
            "another topic"
        )
    pixels = _pixels(message, layout.dtype, layout.channels, where)
    pixels = (pixels >> 8).astype(np.uint8) if layout.dtype == "u2" else pixels
    return np.ascontiguousarray(layout.to_rgb(pixels))


def depth_of(message: Any, where: str, *, scale_m: float | None = None) -> Float32[np.ndarray, "H W"]:
    """Depth in metres of an Image or CompressedImage, 0 where missing; by default in the units of :func:`unit_of`.

    Raises:
        RecordingError: the picture is corrupt, or of an encoding that is not of depth.
    """
    unit_m = np.float32(unit_of(message) if scale_m is None else scale_m)
    if not hasattr(message, "encoding"):
        return _compressed_depth(message, where, unit_m)
    if message.encoding == "32FC1":
        return clean_depth(_pixels(message, "f4", 1, where) * unit_m)
    if message.encoding in DEPTH_ENCODINGS:
        return metres(_pixels(message, "u2", 1, where), float(unit_m))
    raise RecordingError(
        f"{where}: encoding {message.encoding!r} is not one of depth; expected {', '.join(DEPTH_ENCODINGS)}; name "
        "another topic, or omit the depth"
    )


def _pixels(message: Any, dtype: str, channels: int, where: str) -> np.ndarray:
    """Pixels of an Image without the padding of its rows, in this machine's byte order."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    kind = np.dtype(dtype).newbyteorder(">" if message.is_bigendian else "<")
    row = width * channels * kind.itemsize
    data = np.frombuffer(message.data, dtype=np.uint8)
    if height <= 0 or width <= 0 or step < row or data.size < step * (height - 1) + row:
        raise RecordingError(
            f"{where}: {data.size} bytes for {width} x {height} pixels of {message.encoding} in rows of {step} bytes; "
            "the message is corrupt, record it again"
        )
    whole = np.pad(data, (0, max(0, step * height - data.size)))  # some drivers leave out the last row's padding
    rows = np.ascontiguousarray(whole[: step * height].reshape(height, step)[:, :row]).view(kind)
    return rows.reshape((height, width) if channels == 1 else (height, width, channels)).astype(np.dtype(dtype))


def _compressed_depth(message: Any, where: str, unit_m: np.float32) -> np.ndarray:
    encoding, data = encoding_of(message), bytes(message.data)
    kind = encoding.partition(";")[0].strip()
    if "compressedDepth" not in encoding:
        return _grey16(data, where).astype(np.float32) * unit_m
    if len(data) <= _HEADER.size:
        raise RecordingError(f"{where}: {len(data)} bytes of compressed depth; the message is corrupt, record it again")
    _, quant_a, quant_b = _HEADER.unpack_from(data)
    if "rvl" in encoding.lower():
        with reading(where, RecordingError, "the message is torn, record it again"):
            units = decode_rvl(data[_HEADER.size :])
    else:
        units = _grey16(data[_HEADER.size :], where)
    if kind != "32FC1":
        return units.astype(np.float32) * unit_m
    with np.errstate(divide="ignore"):
        depth_m = quant_a / (units.astype(np.float64) - quant_b)
    return clean_depth(np.where((units > 0) & (units < np.iinfo(np.uint16).max), depth_m * unit_m, 0.0))


def _grey16(data: bytes, where: str) -> np.ndarray:
    image = _decode(data, where, cv2.IMREAD_UNCHANGED)
    if image.ndim != 2 or image.dtype != np.uint16:
        raise RecordingError(
            f"{where}: expected 16-bit grey, got {image.dtype} of shape {image.shape}; compress depth with "
            "compressedDepth"
        )
    return image


def _decode(data: Any, where: str, flags: int) -> np.ndarray:
    raw = np.frombuffer(data, dtype=np.uint8)
    try:
        image = cv2.imdecode(raw, flags) if raw.size else None
    except cv2.error:
        image = None
    if image is None:
        raise RecordingError(
            f"{where}: {raw.size} bytes are no JPEG or PNG, or too large; the message is torn, record it again"
        )
    return np.asarray(image)


def decode_rvl(data: bytes) -> UInt16[np.ndarray, "H W"]:
    """A picture from its width and height, four bytes each, and its runs.

    Raises:
        ValueError: the bytes are no such picture.
    """
    if len(data) < _RVL_SIZE.size:
        raise ValueError(f"{len(data)} bytes")
    width, height = _RVL_SIZE.unpack_from(data)
    if not 0 < width * height <= _MOST_RVL_PIXELS:
        raise ValueError(f"a picture of {width} x {height}")
    numbers = _rvl_numbers(data[_RVL_SIZE.size :])
    pixels = np.zeros(width * height, np.int64)
    where = np.zeros(width * height, bool)
    spans: list[np.ndarray] = []
    at, pixel = 0, 0
    while pixel < len(pixels):
        if at >= len(numbers):
            raise ValueError(f"it ends after {pixel} of {len(pixels)} pixels")
        pixel += int(numbers[at])
        count = int(numbers[at + 1]) if at + 1 < len(numbers) else 0
        if pixel + count > len(pixels) or at + 2 + count > len(numbers):
            raise ValueError(f"a run of {count} from pixel {pixel} on of {len(pixels)}")
        where[pixel : pixel + count] = True
        spans.append(numbers[at + 2 : at + 2 + count])
        at, pixel = at + 2 + count, pixel + count
    coded = np.concatenate(spans)
    pixels[where] = np.cumsum((coded >> 1) ^ -(coded & 1))
    return pixels.astype(np.uint16).reshape(height, width)


def _rvl_numbers(data: bytes) -> np.ndarray:
    """All numbers of a stream of words of 32 bits, each of eight groups, the first in the highest bits."""
    words = np.frombuffer(data[: len(data) // 4 * 4], "<u4")
    groups = ((words[:, None] >> np.arange(28, -4, -4, dtype=np.uint32)) & 15).ravel().astype(np.int64)
    ends = np.flatnonzero(groups < 8)
    if not len(ends):
        return np.zeros(0, np.int64)
    starts = np.concatenate(([0], ends[:-1] + 1))
    place = np.arange(ends[-1] + 1) - np.repeat(starts, ends - starts + 1)
    if place.max() >= _LONGEST:
        raise ValueError("a number of more than 32 bits")
    return np.add.reduceat((groups[: ends[-1] + 1] & 7) << (3 * place), starts)
