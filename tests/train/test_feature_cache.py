"""Features on disk: whole, of this take and of this encoder, or made again."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from quest.data.store import TakeStore
from quest.errors import ConfigError
from quest.train.feature_cache import FeatureCache, encode_images
from quest.viz.contact_sheet import contact_sheet
from tests.paper.tiny import make_paper
from tests.synthetic import make_take
from tests.tolerances import PIXEL
from tests.train.prepared import CPU

NAME = "panels-0"


def store_with(folder: Path, **changes) -> TakeStore:
    shutil.rmtree(folder / "takes", ignore_errors=True)
    store = TakeStore(folder / "takes")
    store.write(make_take(**{"frames": 4, "views": 2, "entities": 2, "seed": 0, **changes}))
    return store


def cache_in(folder: Path, *, seed: int = 0) -> FeatureCache:
    return FeatureCache(folder / "cache", make_paper(seed=seed).encoder)


def build(cache: FeatureCache, store: TakeStore) -> tuple[int, ...]:
    return tuple(cache.build(store, store.names(), device=CPU))


def times(folder: Path) -> list[int]:
    return [path.stat().st_mtime_ns for path in sorted(folder.glob("cache/*/*/features.npy"))]


def test_what_is_cached_is_what_the_take_holds(tmp_path: Path):
    store, cache = store_with(tmp_path, hinges=True), cache_in(tmp_path)
    assert build(cache, store) == (4, 4)
    take = store.read(NAME)
    for v, view in enumerate(cache.views([NAME])):
        truth = take.views[v]
        assert (view.object_id, len(view)) == (NAME, 4)
        assert truth.clip.depth_m is not None
        np.testing.assert_allclose(view.depth * 1e-4, truth.clip.depth_m, atol=1e-6)
        np.testing.assert_allclose(view.uv_px, truth.uv_px[:, :2], **PIXEL)
        np.testing.assert_array_equal(view.visible, truth.visible[:, :2])
        assert view.label.tolist() == [0, 1]
        assert view.revolute.tolist() == [False, True]
        with torch.no_grad():
            expected = make_paper().encode(torch.from_numpy(truth.clip.rgb)).numpy()
        assert np.abs(view.features - expected).max() < 0.1 * np.abs(expected).max()


def test_what_is_fixed_in_the_base_has_no_joint(tmp_path: Path):
    """The last joint is not taken for its."""
    take, store = make_take(frames=4, views=1, entities=2), TakeStore(tmp_path / "takes")
    first, second = take.info.entities[:2]
    rim = replace(second, link=0, joint=-1)
    assert (rim.fixed, rim.intent, first.fixed, first.intent) == (True, "lift", False, "open")
    take = replace(take, info=replace(take.info, entities=(first, rim)))
    store.write(take)
    assert store.read(NAME).info.entities[1].fixed
    build(cache := cache_in(tmp_path), store)
    (view,) = cache.views([NAME])
    assert view.revolute.tolist() == [False, False]
    np.testing.assert_array_equal(view.axis_world[0], take.joint_axis[0, first.joint])
    assert not view.axis_world[1].any()
    assert contact_sheet(take, columns=2, tile_width_px=64).std() > 0


def test_nothing_is_made_twice(tmp_path: Path):
    store = store_with(tmp_path)
    build(cache_in(tmp_path), store)
    before = times(tmp_path)
    assert build(cache_in(tmp_path), store) == (4, 4)
    assert times(tmp_path) == before


def test_frames_of_another_take_are_no_pictures_of_this_ones_truth(tmp_path: Path):
    """A thinned take has the name of the whole one: one run reads on while another prepares the other."""
    cache = cache_in(tmp_path)
    build(cache, store_with(tmp_path))
    view = cache.views([NAME])[0]
    build(cache_in(tmp_path), store_with(tmp_path, frames=8))
    with pytest.raises(ConfigError, match="its own --cache"):
        _ = view.features


def test_another_take_of_the_same_name_is_made_again(tmp_path: Path):
    build(cache_in(tmp_path), store_with(tmp_path))
    build(cache_in(tmp_path), store_with(tmp_path, frames=5, views=1, name=NAME, seed=3))
    views = cache_in(tmp_path).views([NAME])
    assert [len(view) for view in views] == [5], "the second view belongs to the take that is gone"


def test_another_encoder_makes_features_again(tmp_path: Path):
    store = store_with(tmp_path)
    build(cache_in(tmp_path), store)
    old = np.array(cache_in(tmp_path).views([NAME])[0].features)
    reading = cache_in(tmp_path).views([NAME])[0]
    build(cache_in(tmp_path, seed=1), store)
    assert not np.allclose(cache_in(tmp_path, seed=1).views([NAME])[0].features, old)
    np.testing.assert_array_equal(reading.features, old)  # two runs share the folder


def test_a_killed_run_leaves_nothing_that_is_taken_for_whole(tmp_path: Path):
    store, cache = store_with(tmp_path), cache_in(tmp_path)
    build(cache, store)
    left = cache.root / f".partial-{NAME}-v1.12345"
    (cache.root / f"{NAME}-v1").rename(left)
    (left / "features.npy").write_bytes(b"torn")
    os.utime(left, (0, 0))
    assert len(cache.views([NAME])) == 1
    assert build(cache, store) == (4, 4)
    assert len(cache.views([NAME])) == 2
    assert not list(cache.root.glob(".*"))


def test_a_removal_that_was_killed_is_made_good(tmp_path: Path):
    store, cache = store_with(tmp_path), cache_in(tmp_path)
    build(cache, store)
    (cache.root / f"{NAME}-v0" / "meta.json").unlink()
    assert build(cache, store) == (4, 4)


def test_names_that_begin_alike_stay_apart(tmp_path: Path):
    store = TakeStore(tmp_path / "takes")
    for name in ("a", "a-v1", "a-v1-v0"):
        store.write(make_take(frames=4, views=1, entities=2, name=name))
    cache = cache_in(tmp_path)
    assert build(cache, store) == (4, 4, 4)
    assert [v.name for v in cache.views(["a"])] == ["a-v0"]
    assert [v.name for v in cache.views(["a-v1"])] == ["a-v1-v0"]


def test_an_empty_cache(tmp_path: Path):
    with pytest.raises(ConfigError, match="no prepared views"):
        cache_in(tmp_path).views([NAME])


def test_batches_of_images_do_not_matter():
    encoder = make_paper().encoder
    rgb = np.random.default_rng(0).integers(0, 255, (5, 64, 64, 3)).astype(np.uint8)
    one, all_ = (encode_images(encoder, rgb, device=CPU, batch=n) for n in (2, 5))
    np.testing.assert_allclose(one.astype(float), all_.astype(float), atol=0.05)
