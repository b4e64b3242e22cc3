"""Colours of image files: upright, and eight bits a channel whatever the file has."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import ExifTags, Image, ImageOps

from quest.errors import InputError, RecordingError
from quest.untrusted import reading, require_file

PICTURES = (".jpg", ".jpeg", ".png", ".bmp", ".webp", ".pgm", ".ppm", ".tif", ".tiff")
"""Endings of files that are pictures."""

TURNED = (
    "EXIF or the video's header says that the colours are to be turned, and their depth is not turned with them; "
    "write colours and depth the same way up and omit the orientation, or omit the depth"
)


def open_image(path: Path) -> Image.Image:
    """An image file, decoded.

    Raises:
        RecordingError: it cannot be read.
    """
    require_file(path, RecordingError)
    remedy = "the file is torn, copy or record it again"
    with reading(f"image {path}", RecordingError, remedy), Image.open(path) as image:
        image.load()
        return image


def is_turned(image: Image.Image) -> bool:
    """Whether EXIF says that the pixels are to be turned or mirrored."""
    return image.getexif().get(ExifTags.Base.Orientation, 1) in range(2, 9)


def upright(image: Image.Image) -> Image.Image:
    """The image as EXIF says that it is to be seen."""
    return ImageOps.exif_transpose(image)


def read_picture(path: Path) -> UInt8[np.ndarray, "H W 3"]:
    """Colours of a picture, upright.

    Raises:
        InputError: it cannot be read.
    """
    return decode_picture(path, f"picture {path}")


def decode_picture(file: Path | BytesIO, where: str) -> UInt8[np.ndarray, "H W 3"]:
    """Colours of an image file, upright.

    Args:
        file: its path, or the file itself.
        where: its name in errors.

    Raises:
        InputError: it cannot be read.
    """
    if isinstance(file, Path):
        require_file(file, InputError)
    with reading(where, InputError), Image.open(file) as image:
        return colours_of(upright(image), where)


def colours_of(image: Image.Image, where: str) -> UInt8[np.ndarray, "H W 3"]:
    """Colours of an image, as its pixels lie; of 16-bit grey the higher byte.

    Args:
        image: the image.
        where: its name in errors.

    Raises:
        RecordingError: the pixels are of 32 bits or floats, so that white is unknown.
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
