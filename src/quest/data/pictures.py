"""Pictures in files: colours, upright and of eight bits a channel whatever the file has, and depth as it is stored.

Depth is 16-bit PNG, PGM and TIFF in some unit, or float TIFF, EXR and NumPy arrays in metres.
"""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import Shaped, UInt8
from PIL import ExifTags, Image, ImageOps

from quest.errors import InputError, RecordingError
from quest.untrusted import reading, require_file

PICTURES = (".jpg", ".jpeg", ".png", ".bmp", ".webp", ".pgm", ".ppm", ".tif", ".tiff")
"""Endings of files that are pictures."""
DEPTH_SUFFIXES = (".png", ".pgm", ".tif", ".tiff", ".exr", ".npy")
"""Endings of files that may be depth."""
TURNED = (
    "EXIF or the video's header says that the colours are to be turned, and their depth is not turned with them; "
    "write colours and depth the same way up and omit the orientation, or omit the depth"
)

_TORN = "the file is torn, copy or record it again"
_CHANNELS = ("Z", "depth", "Y", "R", "RGB", "RGBA")
"""Where EXR files keep depth; Record3D in R."""
_MOST_PIXELS = 2**26


def open_image(path: Path) -> Image.Image:
    """An image file, decoded.

    Raises:
        RecordingError: it cannot be read.
    """
    require_file(path, RecordingError)
    with reading(f"image {path}", RecordingError, _TORN), Image.open(path) as image:
        image.load()
        return image


def is_turned(image: Image.Image) -> bool:
    """Whether EXIF says that the pixels are to be turned or mirrored."""
    return image.getexif().get(ExifTags.Base.Orientation, 1) in range(2, 9)


def upright(image: Image.Image) -> Image.Image:
    """The image as EXIF says that it is to be seen."""
    return ImageOps.exif_transpose(image)


def read_picture(path: Path) -> UInt8[np.ndarray, "H W 3"]:
    """Colours of a picture, upright; an InputError if it cannot be read."""
    return decode_picture(path, f"picture {path}")


def decode_picture(file: Path | BytesIO, where: str) -> UInt8[np.ndarray, "H W 3"]:
    """Colours of an image file, upright; an InputError that names ``where`` if it cannot be read."""
    if isinstance(file, Path):
        require_file(file, InputError)
    with reading(where, InputError), Image.open(file) as image:
        return colours_of(upright(image), where)


def colours_of(image: Image.Image, where: str) -> UInt8[np.ndarray, "H W 3"]:
    """Colours of an image, as its pixels lie; of 16-bit grey the higher byte.

    Raises:
        RecordingError: the pixels are of 32 bits or floats, so that white is unknown; it names ``where``.
    """
    if image.mode.startswith("I;16"):
        grey = (np.asarray(image) >> 8).astype(np.uint8)
        return np.repeat(grey[..., None], 3, axis=-1)
    if image.mode in ("I", "F"):
        raise RecordingError(
            f"{where}: expected colours or grey of 8 or 16 bits, got mode {image.mode} (32 bits), whose white is not "
            "known; write the colours as 8-bit PNG or JPEG"
        )
    return np.asarray(image.convert("RGB"))


def read_depth_file(path: Path) -> Shaped[np.ndarray, "H W"]:
    """A depth picture as it lies in its file: integers of 16 bits in some unit, or floats.

    Raises:
        RecordingError: it cannot be read, or is a picture of something else.
    """
    require_file(path, RecordingError)
    suffix = path.suffix.lower()
    with reading(f"depth image {path}", RecordingError, _TORN):
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
