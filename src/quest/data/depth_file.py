"""Depth pictures as files: 16-bit PNG, PGM and TIFF in some unit, float TIFF, EXR and NumPy arrays in metres."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Shaped

from quest.data.pictures import open_image
from quest.errors import RecordingError
from quest.untrusted import reading, require_file

DEPTH_SUFFIXES = (".png", ".pgm", ".tif", ".tiff", ".exr", ".npy")
"""Endings of files that may be depth."""

_REMEDY = "the file is torn, copy or record it again"
_CHANNELS = ("Z", "depth", "Y", "R", "RGB", "RGBA")
"""Where EXR files keep depth; Record3D in R."""
_MOST_PIXELS = 2**26


def read_depth_file(path: Path) -> Shaped[np.ndarray, "H W"]:
    """A depth picture as it lies in its file: integers of 16 bits in some unit, or floats.

    Raises:
        RecordingError: it cannot be read, or is a picture of something else.
    """
    require_file(path, RecordingError)
    suffix = path.suffix.lower()
    with reading(f"depth image {path}", RecordingError, _REMEDY):
        read = {".exr": _read_exr, ".npy": _read_array}.get(suffix, lambda path: np.asarray(open_image(path)))
        units = read(path)
    units = units.squeeze() if units.ndim == 3 else units
    if units.ndim != 2 or not (units.dtype.kind == "f" or units.dtype in (np.uint16, np.int32, np.uint32)):
        raise RecordingError(
            f"depth image {path}: expected one channel of 16 bits or floats, got {units.dtype} of shape {units.shape}; "
            "write depth as 16-bit PNGs (millimetres, say), not as a coloured or 8-bit picture"
        )
    return units


def _read_array(path: Path) -> np.ndarray:
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)  # mapped: a header that lies allocates nothing
    except ValueError as error:  # whose advice may be to allow pickles
        raise ValueError("it is no array of numbers") from error
    if not isinstance(array, np.ndarray) or array.ndim not in (2, 3):
        raise ValueError("it holds no picture")
    return np.array(array)


def _read_exr(path: Path) -> np.ndarray:
    import OpenEXR

    corners = np.array(OpenEXR.File(str(path), header_only=True).header()["dataWindow"], np.int64)
    pixels = int(np.prod(corners[1] - corners[0] + 1))
    if not 0 < pixels <= _MOST_PIXELS:  # nothing is allocated for what a header claims
        raise ValueError(f"a picture of {pixels} pixels")
    channels = OpenEXR.File(str(path)).channels()
    name = next((name for name in _CHANNELS if name in channels), None)
    if name is None:
        raise ValueError(f"its channels are {', '.join(channels)}, expected one of {', '.join(_CHANNELS)}")
    pixels = np.asarray(channels[name].pixels)
    return (pixels[..., 0] if pixels.ndim == 3 else pixels).astype(np.float32)
