"""Videos with labelled points, one ``.npz`` each, in the layouts of TAP-Vid and TAPVid-3D (``docs/metrics.md``).

Nothing is unpickled: TAP-Vid's own files are pickles, which their owner rewrites once.

Reference: google-deepmind/tapnet, ``tapnet/tapvid/README.md`` and ``tapnet/tapvid3d/README.md``.
"""

from __future__ import annotations

import io
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Bool, Float, Int
from PIL import Image

from quest.errors import InputError
from quest.evaluation.tapvid.scores import Queries
from quest.types import Camera, Clip

SIDE_PX = 256
"""Of the pictures in whose pixels distances are measured."""

STRIDE = 5
"""Every so many frames points are asked for by ``strided``."""


@dataclass(frozen=True)
class PointVideo:
    """A video and N true tracks."""

    clip: Clip
    occluded: Bool[np.ndarray, "N T"]
    """Whether a point is hidden or out of view."""
    uv_px: Float[np.ndarray, "N T 2"]
    """Pixels of the clip, centres at half-integers; finite where it is visible."""
    point_cam: Float[np.ndarray, "N T 3"] | None = None
    """Metres, in the axes of the camera of that frame; None in TAP-Vid."""
    given_xyt: Float[np.ndarray, "N 3"] | None = None
    """Pixel and frame of the queries that come with the video; None in TAP-Vid."""

    def queries(self, mode: Queries) -> tuple[Int[np.ndarray, " Q"], Int[np.ndarray, " Q"], Float[np.ndarray, "Q 2"]]:
        """Track, frame and pixel of every query; those of ``first`` are the given ones if there are any."""
        if mode == "strided":
            nth, track = np.nonzero(~self.occluded[:, ::STRIDE].T)
            frame = nth * STRIDE
        elif self.given_xyt is not None:
            frame = np.round(self.given_xyt[:, 2]).astype(int)
            return np.arange(len(frame)), frame, self.given_xyt[:, :2]
        else:
            track = np.flatnonzero(~self.occluded.all(axis=1))
            frame = self.occluded[track].argmin(axis=1)
        return track, frame, self.uv_px[track, frame]


def read_video(path: Path, *, name: str = "", square: bool = True) -> PointVideo:
    """Read a video.

    Args:
        path: the file.
        name: of the clip; that of the file by default.
        square: scale videos of TAP-Vid to 256 x 256, as that benchmark does. Those of TAPVid-3D are not scaled.

    Raises:
        InputError: the file is missing or damaged, an array is missing or of another shape, or nothing is visible.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            rgb = file["video" if "video" in file else "images_jpeg_bytes"]
            if rgb.dtype.kind == "S":
                rgb = np.stack([np.asarray(Image.open(io.BytesIO(image)).convert("RGB")) for image in rgb.tolist()])
            if rgb.ndim != 4 or rgb.shape[3] != 3 or rgb.dtype != np.uint8 or not rgb.size:
                raise InputError(f"expected video [T, H, W, 3] of uint8, got {list(rgb.shape)} of {rgb.dtype}")
            video = (_in_space if "tracks_XYZ" in file else _in_pictures)(file, rgb, name or path.stem, square)
        if video.occluded.all() or not np.isfinite(video.uv_px[~video.occluded]).all():
            raise InputError("expected visible points, and all of them finite and in front of the camera")
    except (OSError, ValueError, KeyError, TypeError, EOFError, BadZipFile, zlib.error) as error:
        raise InputError(f"{path}: expected a video in a layout of docs/metrics.md ({error})") from error
    return video


def _in_pictures(file: Mapping[str, np.ndarray], rgb: np.ndarray, name: str, square: bool) -> PointVideo:
    points = _numbers(file, "points", (None, len(rgb), 2))
    if square and rgb.shape[1:3] != (SIDE_PX, SIDE_PX):
        side = (SIDE_PX, SIDE_PX)  # by the filter of the benchmark's own reader
        rgb = np.stack([np.asarray(Image.fromarray(frame).resize(side, Image.Resampling.LANCZOS)) for frame in rgb])
    occluded = _numbers(file, "occluded", points.shape[:2]) > 0
    return PointVideo(Clip.from_arrays(rgb, name=name), occluded, points * np.array([rgb.shape[2], rgb.shape[1]]))


def _in_space(file: Mapping[str, np.ndarray], rgb: np.ndarray, name: str, square: bool) -> PointVideo:
    t, height, width = rgb.shape[:3]
    point = _numbers(file, "tracks_XYZ", (t, None, 3)).swapaxes(0, 1)
    occluded = _numbers(file, "visibility", (t, len(point))).T == 0
    given = _numbers(file, "queries_xyt", (len(point), 3))
    if not ((given[:, 2] >= 0) & (given[:, 2].round() < t)).all() or not np.isfinite(given).all():
        raise InputError(f"expected queries_xyt in frames below {t}, got {given[:, 2].min()} to {given[:, 2].max()}")
    fx, fy, cx, cy = _numbers(file, "fx_fy_cx_cy", (4,)).tolist()
    camera = Camera(fx, fy, cx, cy, width, height)
    z = np.where(point[..., 2:] > 0, point[..., 2:], np.nan)
    uv_px = point[..., :2] / z * (fx, fy) + (cx, cy)
    depth_m = _numbers(file, "depth_m", rgb.shape[:3]).astype(np.float32) if "depth_m" in file else None
    pose = _numbers(file, "extrinsics_w2c", (t, 4, 4)) if "extrinsics_w2c" in file else None
    return PointVideo(
        Clip.from_arrays(rgb, depth_m, camera, cam_from_world=pose, name=name), occluded, uv_px, point, given
    )


def _numbers(file: Mapping[str, np.ndarray], key: str, shape: tuple[int | None, ...]) -> Float[np.ndarray, "..."]:
    """An array as floats; None stands for any length."""
    array = file[key]
    fits = array.ndim == len(shape) and all(n in (None, have) for n, have in zip(shape, array.shape, strict=True))
    if not fits or array.dtype.kind not in "biuf":
        expected = [n or "N" for n in shape]
        raise InputError(f"expected {key} of shape {expected}, got {list(array.shape)} of {array.dtype}")
    return array.astype(np.float64)
