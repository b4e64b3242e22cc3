"""RVL, the compression of 16-bit depth that ROS offers beside PNG.

A picture is a row of runs: how many zeros, how many others, and of each of these the difference from the one before.
Numbers are written in groups of three bits, the lowest first, with a fourth bit that says that more follow.

Reference: Wilson, "Fast lossless depth image compression", ISS 2017.
"""

from __future__ import annotations

import struct

import numpy as np
from jaxtyping import UInt16

_SIZE = struct.Struct("<II")
_MOST_PIXELS = 2**24
_LONGEST = 11
"""Groups of three bits in a number of 32."""


def decode_rvl(data: bytes) -> UInt16[np.ndarray, "H W"]:
    """A picture from its width and height, four bytes each, and its runs.

    Raises:
        ValueError: the bytes are no such picture.
    """
    if len(data) < _SIZE.size:
        raise ValueError(f"{len(data)} bytes")
    width, height = _SIZE.unpack_from(data)
    if not 0 < width * height <= _MOST_PIXELS:
        raise ValueError(f"a picture of {width} x {height}")
    numbers = _numbers(data[_SIZE.size :])
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


def _numbers(data: bytes) -> np.ndarray:
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
