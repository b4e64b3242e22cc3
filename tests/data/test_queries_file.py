"""Queries as boxes and masks, and in files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from quest.data.queries_file import read_queries, write_queries
from quest.errors import InputError
from quest.types import Query


def test_boxes_and_masks_are_pixels():
    assert Query.box(3, 10, 20, 30, 24, name="a", label="handle") == Query.point(3, 20, 22, name="a", label="handle")
    ring = np.zeros((9, 9), bool)
    ring[2:7, 2:7] = True
    ring[3:6, 3:6] = False
    query = Query.mask(1, torch.from_numpy(ring), label="knob")
    assert query.uv_px is not None
    x, y = query.uv_px
    assert ring[int(y), int(x)], "the centroid of a ring is not on it"
    assert Query.mask(0, np.eye(3, dtype=np.uint8)[::-1]).uv_px == (1.5, 1.5)


def test_boxes_and_masks_of_nothing_are_refused():
    for corners in ((5, 5, 5, 9), (9, 5, 5, 9), (0, 0, float("inf"), 9)):
        with pytest.raises(InputError, match="with an area"):
            Query.box(0, *corners)
    for mask in (np.zeros((4, 4)), np.ones((4, 4, 3)), np.ones(4)):
        with pytest.raises(InputError, match="at least one pixel"):
            Query.mask(0, mask)


def test_queries_come_back(tmp_path: Path):
    queries = [
        Query.point(3, 1.25, 2.5, name="größer", label="rim"),
        Query.semantic("handle", intent="lift"),
        Query.text("the left handle"),
        Query.slot(),
    ]
    write_queries(queries, tmp_path / "new" / "queries.json")
    assert read_queries(tmp_path / "new" / "queries.json") == queries
    write_queries([], tmp_path / "none.json")
    assert read_queries(tmp_path / "none.json") == []


@pytest.mark.parametrize(
    "text",
    ["", "[]", '{"version": 2, "queries": []}', '{"version": 1, "queries": [{"kind": "point"}]}', '{"version": 1}',
     '{"version": 1, "queries": [{"kind": "semantic", "label": "wheel"}]}',
     '{"version": 1, "queries": [{"kind": "point", "frame": 0, "uv_px": [1e999, 2]}]}'],
)  # fmt: skip
def test_files_that_are_none_are_refused(text: str, tmp_path: Path):
    path = tmp_path / "queries.json"
    with pytest.raises(InputError, match="no such file"):
        read_queries(path)
    path.write_text(text)
    with pytest.raises(InputError, match=r"queries\.json"):
        read_queries(path)
