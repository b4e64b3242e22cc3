"""Contact sheets and the command that draws them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from quest.cli.data import Data, DataList, DataShow
from quest.data.store import TakeStore
from quest.errors import InputError, TakeError
from quest.types import Take
from quest.viz.contact_sheet import contact_sheet
from quest.viz.palette import query_colour
from tests.synthetic import make_take


@pytest.fixture(scope="module")
def take() -> Take:
    return make_take(frames=9, hinges=True, size=(64, 48), name="panels")


def has_colour(sheet: np.ndarray, colour: tuple[int, int, int]) -> bool:
    return bool((sheet == np.array(colour, dtype=np.uint8)).all(axis=-1).any())


def test_every_entity_is_on_the_sheet(take: Take):
    sheet = contact_sheet(take)
    assert sheet.dtype == np.uint8
    assert sheet.ndim == 3
    for e in take.tracked:
        assert has_colour(sheet, query_colour(int(e)))


@pytest.mark.parametrize("variant", ["one frame", "no depth", "one view", "wide"])
def test_variants_of_takes(take: Take, variant: str):
    if variant == "one frame":
        take = make_take(frames=1, size=(20, 30))
    elif variant == "no depth":
        views = tuple(replace(view, clip=replace(view.clip, depth_m=None)) for view in take.views)
        take = replace(take, views=views)
    elif variant == "one view":
        take = replace(take, views=take.views[:1])
    else:
        take = make_take(frames=3, views=1, size=(640, 120))
    assert contact_sheet(take, columns=3).shape[1] >= 900


def test_nothing_to_draw(take: Take):
    with pytest.raises(InputError, match="expected a view"):
        contact_sheet(replace(take, views=()))
    with pytest.raises(InputError, match="a column"):
        contact_sheet(take, columns=0)


def test_command_show(take: Take, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    TakeStore(tmp_path / "store").write(take)
    out = tmp_path / "pictures" / "sheet.png"
    assert Data(DataShow(tmp_path / "store" / "panels.zarr", out=out, columns=4)).run() == 0
    assert Image.open(out).width > 900
    assert str(out) in capsys.readouterr().out


def test_command_show_of_what_is_no_take(tmp_path: Path):
    with pytest.raises(TakeError, match="no folder"):
        DataShow(tmp_path / "panels.zarr").run()
    with pytest.raises(TakeError, match="expected the folder of a take"):
        DataShow(tmp_path).run()


def test_command_list(take: Take, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    store = TakeStore(tmp_path)
    store.write(take)
    store.write(replace(take, info=replace(take.info, name="torn")))
    assert DataList(tmp_path, verify=True).run() == 0
    (store.path("torn") / "zarr.json").unlink()
    assert DataList(tmp_path).run() == 1
    captured = capsys.readouterr()
    assert "panels" in captured.out
    assert "torn" in captured.err
    with pytest.raises(TakeError, match="no such folder"):
        DataList(tmp_path / "nowhere").run()
