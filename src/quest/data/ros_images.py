"""Pictures in ROS messages: ``sensor_msgs/Image``, ``CompressedImage`` and the depth that image_transport compresses.

Reference: the message definitions of sensor_msgs; REP 118 (depth images: 16UC1 in millimetres, 32FC1 in metres);
``compressed_depth_image_transport`` for its header of twelve bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from quest.data.rvl import decode_rvl
from quest.depth import clean_depth, metres
from quest.errors import RecordingError
from quest.untrusted import reading

DEPTH_ENCODINGS = ("16UC1", "32FC1", "mono16")
"""Encodings of depth; mono16 also occurs for infrared pictures."""

_MILLIMETRE_M = 1e-3
_HEADER = struct.Struct("<iff")
_BAYER = {"rggb": "RGGB", "bggr": "BGGR", "gbrg": "GBRG", "grbg": "GRBG"}


@dataclass(frozen=True)
class _Layout:
    """How pixels lie in a message: element type, channels, and the conversion to RGB."""

    dtype: str
    channels: int
    to_rgb: Callable[[np.ndarray], np.ndarray]


def _converted(code: int) -> Callable[[np.ndarray], np.ndarray]:
    return lambda image: np.asarray(cv2.cvtColor(image, code))


def _bayer(pattern: str, *, wide: bool) -> _Layout:
    code = getattr(cv2, f"COLOR_Bayer{_BAYER[pattern]}2RGB")
    if wide:
        return _Layout("u2", 1, lambda image: np.asarray(cv2.cvtColor(_to_bytes(image), code)))
    return _Layout("u1", 1, _converted(code))


def _to_bytes(image: np.ndarray) -> np.ndarray:
    return (image >> 8).astype(np.uint8)


_RGB = _Layout("u1", 3, lambda image: image)
_BGR = _Layout("u1", 3, lambda image: image[..., ::-1])
_BGRA = _Layout("u1", 4, lambda image: image[..., 2::-1])
_GREY = _Layout("u1", 1, lambda image: np.repeat(image[..., None], 3, axis=-1))
_COLOURS = {
    "rgb8": _RGB,
    "bgr8": _BGR,
    "8UC3": _BGR,
    "rgba8": _Layout("u1", 4, lambda image: image[..., :3]),
    "bgra8": _BGRA,
    "8UC4": _BGRA,
    "rgb16": _Layout("u2", 3, _to_bytes),
    "bgr16": _Layout("u2", 3, lambda image: _to_bytes(image[..., ::-1])),
    "mono8": _GREY,
    "8UC1": _GREY,
    "yuv422": _Layout("u1", 2, _converted(cv2.COLOR_YUV2RGB_UYVY)),
    "uyvy": _Layout("u1", 2, _converted(cv2.COLOR_YUV2RGB_UYVY)),
    "yuv422_yuy2": _Layout("u1", 2, _converted(cv2.COLOR_YUV2RGB_YUY2)),
    "yuyv": _Layout("u1", 2, _converted(cv2.COLOR_YUV2RGB_YUY2)),
    **{f"bayer_{pattern}8": _bayer(pattern, wide=False) for pattern in _BAYER},
    **{f"bayer_{pattern}16": _bayer(pattern, wide=True) for pattern in _BAYER},
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
    return np.ascontiguousarray(layout.to_rgb(_pixels(message, layout.dtype, layout.channels, where)))


def depth_of(message: Any, where: str, *, scale_m: float | None = None) -> Float32[np.ndarray, "H W"]:
    """Depth in metres of an Image or CompressedImage, 0 where missing.

    Args:
        message: the picture.
        where: its name in errors.
        scale_m: metres per unit; by default that of :func:`unit_of`.

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
