"""TAPVid-3D examples: keys, shapes and conventions as the benchmark's own loader reads them."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from quest.data.export_tapvid3d import export_tapvid3d
from quest.errors import InputError
from quest.types import Take
from tests.synthetic import make_take


@pytest.fixture(scope="module")
def take() -> Take:
    """Two views, of which the second has a moving camera and never sees entity 1."""
    take = make_take(frames=16, views=2, entities=3, hinges=True, size=(80, 64), name="panels")
    view = take.views[1]
    shake = np.tile(np.eye(4), (16, 1, 1))
    shake[:, 2, 3] = np.linspace(0, 0.4, 16)
    pose = shake @ view.clip.cam_from_world
    point = np.einsum("tij,tej->tei", pose[:, :3, :3], take.point_world) + pose[:, None, :3, 3]
    camera = view.clip.camera
    uv = point[..., :2] / point[..., 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    visible = view.visible.copy()
    visible[:, 1] = False
    visible[:5, 2] = False
    visible[5:, 2] = True
    moving = replace(view, clip=replace(view.clip, cam_from_world=pose), uv_px=uv.astype(np.float32), visible=visible)
    return replace(take, views=(take.views[0], moving))


def test_round_trip(take: Take, tmp_path: Path):
    paths = export_tapvid3d(take, tmp_path / "out", jpeg_quality=100)
    assert [path.name for path in paths] == ["panels-v0.npz", "panels-v1.npz"]
    for path, view, tracked in zip(paths, take.views, ([0, 1, 2], [0, 2]), strict=True):
        with np.load(path, allow_pickle=False) as example:
            arrays = dict(example)
        assert not any(array.dtype.hasobject for array in arrays.values())
        point, (fx, fy, cx, cy) = arrays["tracks_XYZ"], arrays["fx_fy_cx_cy"]
        uv = point[..., :2] / point[..., 2:] * [fx, fy] + [cx, cy]
        assert np.abs(uv - view.uv_px[:, tracked]).max() < 0.01
        assert np.array_equal(arrays["visibility"], view.visible[:, tracked])
        t = arrays["queries_xyt"][:, 2].astype(int)
        assert np.array_equal(t, view.visible[:, tracked].argmax(axis=0))
        query = arrays["queries_xyt"][:, :2]
        assert np.abs(query - uv[t, np.arange(len(t))]).max() < 0.01
        pose = arrays["extrinsics_w2c"]
        world = np.einsum("tji,tnj->tni", pose[:, :3, :3], point - pose[:, None, :3, 3])
        assert np.abs(world - take.point_world[:, tracked]).max() < 1e-5
        assert list(arrays["track_names"]) == [take.info.entities[e].name for e in tracked]
        images = arrays["images_jpeg_bytes"]
        assert (images.shape, images.dtype.kind) == ((16,), "S")
        for jpeg, rgb in zip(images, view.clip.rgb, strict=True):
            assert jpeg.endswith(b"\xff\xd9")
            found = np.asarray(Image.open(io.BytesIO(jpeg)).convert("RGB"))
            assert np.abs(found.astype(int) - rgb).mean() < 2


def test_depth_only_if_asked_for_and_no_views_without_entities(take: Take, tmp_path: Path):
    blind = replace(take.views[0], visible=np.zeros_like(take.views[0].visible))
    for depth in (False, True):
        paths = export_tapvid3d(replace(take, views=(blind, take.views[1])), tmp_path, depth=depth)
        assert [path.name for path in tmp_path.iterdir()] == [path.name for path in paths] == ["panels-v1.npz"]
        with np.load(paths[0], allow_pickle=False) as example:
            assert ("depth_m" in example) == depth
            if depth:
                np.testing.assert_array_equal(example["depth_m"], take.views[1].clip.depth_m)
    with pytest.raises(InputError, match="quality of 1 to 100"):
        export_tapvid3d(take, tmp_path, jpeg_quality=0)
