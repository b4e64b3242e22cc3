"""Which takes teach and which choose."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from quest.errors import ConfigError
from quest.train.dataset import UNSTATED, Dataset, licence_after, open_dataset
from quest.train.settings import WindowConfig
from tests.paper.tiny import make_paper
from tests.train.prepared import CPU, make_store

TRAIN, VALIDATION, TEST, UNLISTED = 3, 100003, 110003, 999999


def opened(tmp_path: Path, seeds: Sequence[int], validation: Sequence[int] = ()) -> tuple[Dataset, list[tuple]]:
    stores = [make_store(tmp_path / "a", seeds, frames=4).root]
    chosen = [make_store(tmp_path / "b", validation, frames=4).root] if validation else []
    told: list[tuple] = []
    dataset = open_dataset(
        make_paper(),
        stores=stores,
        validation_stores=chosen,
        cache=tmp_path / "cache",
        windows=WindowConfig(),
        device=CPU,
        report=lambda *values: told.append(values),
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


def test_the_licence_says_what_taught():
    bound = "Apache-2.0, research use only for the PartNet-Mobility objects that taught"
    assert licence_after("Apache-2.0", {"procedural", "own"}) == "Apache-2.0"
    assert licence_after("Apache-2.0", {"procedural", "partnet-mobility"}) == bound
    assert licence_after(bound, {"partnet-mobility"}) == bound
    assert licence_after("", {"partnet-mobility"}) == ""
    unstated = licence_after("Apache-2.0", {UNSTATED})
    assert "pictures" in unstated
    assert licence_after(unstated, {UNSTATED}) == unstated


def test_own_objects_need_a_store_to_choose_by(tmp_path: Path):
    dataset, _ = opened(tmp_path, (UNLISTED, VALIDATION, TEST), (UNLISTED + 1, TRAIN, TEST))
    assert objects(dataset) == (["panels-999999"], ["panels-1000000", "panels-3"])
    with pytest.raises(ConfigError, match="--validation"):
        opened(tmp_path / "alone", (UNLISTED,))


def test_what_tests_never_teaches_or_chooses(tmp_path: Path):
    with pytest.raises(ConfigError, match="no train takes"):
        opened(tmp_path / "test", (TEST, VALIDATION), (VALIDATION,))
    with pytest.raises(ConfigError, match="no validation takes"):
        opened(tmp_path / "train", (TRAIN,), (TEST,))


def test_no_take_teaches_and_chooses(tmp_path: Path):
    with pytest.raises(ConfigError, match="twice"):
        opened(tmp_path, (UNLISTED,), (UNLISTED,))
