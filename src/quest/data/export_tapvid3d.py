"""Takes as TAPVid-3D examples: one ``.npz`` per view, for whoever evaluates with that benchmark's tools.

The keys and conventions are those of the benchmark's own generators and loaders:

=====================  ======================================================================================
``images_jpeg_bytes``  one JPEG per frame, as an array of byte strings (``S``), which needs no pickle to load
``queries_xyt``        ``[N, 3]``: pixel ``x, y`` and frame ``t`` at which a point is given to the tracker
``tracks_XYZ``         ``[T, N, 3]``: metres, in the axes of the camera *of that frame* (x right, y down, z forward)
``visibility``         ``[T, N]``
``fx_fy_cx_cy``        ``[4]``: pixels; their generators have centres at half-integers, as here
``extrinsics_w2c``     ``[T, 4, 4]``: ``cam_from_world``; there for moving cameras, written for all
``track_names``        ``[N]``: names of the entities; not a key of theirs
``depth_m``            ``[T, H, W]``: metres, 0 where missing; only if asked for, and not a key of theirs
=====================  ======================================================================================

A query is the first frame that shows the entity; entities that the view never shows, and hinges, are left out.

Reference: Koppula et al. (2024), TAPVid-3D: A Benchmark for Tracking Any Point in 3D; google-deepmind/tapnet, folder
``tapnet/tapvid3d``: ``README.md``, ``annotation_generation/adt_utils.py``, ``evaluation/evaluate_model.py``.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from quest.errors import InputError
from quest.types import Take, View
from quest.whole_file import whole_file


def export_tapvid3d(take: Take, folder: str | Path, *, jpeg_quality: int = 95, depth: bool = False) -> list[Path]:
    """Write one ``<take>-v<view>.npz`` per view that shows an entity, with depth if that is asked for; returns them.

    Files of the same names are replaced.

    Raises:
        InputError: the quality is out of range.
    """
    if not 1 <= jpeg_quality <= 100:
        raise InputError(f"TAPVid-3D: expected a JPEG quality of 1 to 100, got {jpeg_quality}")
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for v, view in enumerate(take.views):
        arrays = tapvid3d_arrays(take, view, jpeg_quality=jpeg_quality)
        if len(arrays["queries_xyt"]) == 0:
            continue
        path = folder / f"{take.info.name}-v{v}.npz"
        with whole_file(path) as partial, partial.open("wb") as file:
            if depth and view.clip.depth_m is not None:
                np.savez_compressed(file, allow_pickle=False, **arrays, depth_m=view.clip.depth_m)
            else:
                np.savez(file, allow_pickle=False, **arrays)
        written.append(path)
    return written


def tapvid3d_arrays(take: Take, view: View, *, jpeg_quality: int = 95) -> dict[str, np.ndarray]:
    """The arrays of a view by key; see this module's table."""
    shown = [int(e) for e in take.tracked if view.visible[:, e].any()]
    first = view.visible[:, shown].argmax(axis=0)
    pose = view.clip.cam_from_world.astype(np.float64)
    point = take.point_world[:, shown].astype(np.float64)
    camera = view.clip.camera
    return {
        "images_jpeg_bytes": np.array([_jpeg(rgb, jpeg_quality) for rgb in view.clip.rgb], dtype=np.bytes_),
        "queries_xyt": np.column_stack([view.uv_px[first, shown], first]).astype(np.float64),
        "tracks_XYZ": np.einsum("tij,tnj->tni", pose[:, :3, :3], point) + pose[:, None, :3, 3],
        "visibility": view.visible[:, shown],
        "fx_fy_cx_cy": np.array([camera.fx, camera.fy, camera.cx, camera.cy]),
        "extrinsics_w2c": pose,
        "track_names": np.array([take.info.entities[e].name for e in shown], dtype=np.str_),
    }


def _jpeg(rgb: UInt8[np.ndarray, "H W 3"], quality: int) -> bytes:
    """A JPEG with colour at full resolution. It ends in FF D9: a byte string would lose zeros at its end."""
    data = io.BytesIO()
    Image.fromarray(rgb).save(data, "JPEG", quality=quality, subsampling=0)
    return data.getvalue()
