"""Which takes teach and which choose."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from quest.errors import ConfigError
from quest.train.dataset import Dataset, licence_after, open_dataset
from quest.train.settings import WindowConfig
from tests.tiny import make_network
from tests.tolerances import PIXEL
from tests.train.prepared import CPU, make_store

TRAIN, VALIDATION, TEST, UNLISTED = 3, 100003, 110003, 999999


def opened(
    tmp_path: Path, seeds: Sequence[int], validation: Sequence[int] = (), sources: Sequence[str] | None = None
) -> tuple[Dataset, list[tuple]]:
    stores = [make_store(tmp_path / "a", seeds, frames=4).root]
    chosen = [make_store(tmp_path / "b", validation, frames=4).root] if validation else []
    told: list[tuple] = []
    dataset = open_dataset(
        make_network(),
        stores=stores,
        validation_stores=chosen,
        cache=tmp_path / "cache",
        windows=WindowConfig(),
        device=CPU,
        report=lambda *values: told.append(values),
        sources=sources,
    )
    return dataset, told


def objects(dataset: Dataset) -> tuple[list[str], list[str]]:
    training, validation = (sorted({v.object_id for v in s.views}) for s in (dataset.training, dataset.validation))
    return training, validation


def test_one_store_is_divided_by_the_split(tmp_path: Path):
    dataset, told = opened(tmp_path, (TRAIN, VALIDATION, TEST, UNLISTED))
    assert objects(dataset) == (["panels-3"], ["panels-100003"])
    assert dataset.training_takes == 1
    assert told == [(1, 2, 4), (2, 2, 8)]
    assert dataset.training_sources == {"procedural"}


def test_sources_are_those_of_takes_that_teach(tmp_path: Path):
    dataset, _ = opened(tmp_path / "one", (TRAIN, VALIDATION), sources=("procedural",))
    assert dataset.training_takes == 1
    with pytest.raises(ConfigError, match="no train takes"):
        opened(tmp_path / "other", (TRAIN, VALIDATION), sources=("partnet-mobility",))


def test_the_licence_says_what_taught():
    bound = "Apache-2.0, research use only for the PartNet-Mobility objects that taught"
    assert licence_after("Apache-2.0", {"procedural", "own"}) == "Apache-2.0"
    assert licence_after("Apache-2.0", {"procedural", "partnet-mobility"}) == bound
    assert licence_after(bound, {"partnet-mobility"}) == bound
    assert licence_after("", {"partnet-mobility"}) == ""


def test_own_objects_need_a_store_to_choose_by(tmp_path: Path):
    dataset, _ = opened(tmp_path, (UNLISTED, VALIDATION, TEST), (UNLISTED + 1, TRAIN, TEST))
    assert objects(dataset) == (["panels-999999"], ["panels-1000000"])
    with pytest.raises(ConfigError, match="--validation"):
        opened(tmp_path / "alone", (UNLISTED,))


def test_objects_never_change_sides(tmp_path: Path):
    with pytest.raises(ConfigError, match="no train takes"):
        opened(tmp_path / "test", (TEST,), (VALIDATION,))
    with pytest.raises(ConfigError, match="no validation takes"):
        opened(tmp_path / "train", (TRAIN,), (TRAIN,))


def test_no_take_teaches_and_chooses(tmp_path: Path):
    with pytest.raises(ConfigError, match="twice"):
        opened(tmp_path, (UNLISTED,), (UNLISTED,))


def test_mirror_images_teach_beside_the_takes_or_instead(tmp_path: Path):
    store, chosen = (make_store(tmp_path / n, [seed], frames=4).root for n, seed in (("a", TRAIN), ("b", VALIDATION)))
    open_mirrored = partial(
        open_dataset,
        make_network(),
        validation_stores=[],
        mirrored_stores=[store],
        cache=tmp_path / "cache",
        windows=WindowConfig(),
        device=CPU,
        report=lambda *_: None,
    )
    both = open_mirrored(stores=[store, chosen])
    assert both.training_takes == 2
    alone = open_mirrored(stores=[chosen])
    assert alone.training_takes == 1
    mirrored = alone.training.views[0]
    view = next(v for v in both.training.views if v.name not in {m.name for m in alone.training.views})
    np.testing.assert_array_equal(mirrored.rgb[:, :, ::-1], view.rgb)
    np.testing.assert_allclose(mirrored.uv_px[..., 0], 64 - view.uv_px[..., 0], **PIXEL)
