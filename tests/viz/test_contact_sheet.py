"""Contact sheets of takes and of stores."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from quest.errors import InputError
from quest.types import Take
from quest.viz.contact_sheet import contact_sheet, takes_sheet
from quest.viz.palette import query_colour
from tests.synthetic import make_take


@pytest.fixture(scope="module")
def take() -> Take:
    return make_take(frames=9, hinges=True, size=(64, 48), name="panels")


def has_colour(sheet: np.ndarray, colour: tuple[int, int, int]) -> bool:
    return bool((sheet == np.array(colour, dtype=np.uint8)).all(axis=-1).any())


@pytest.mark.parametrize("variant", ["as it is", "one frame", "no depth", "wide"])
def test_every_entity_is_on_the_sheet(take: Take, variant: str):
    if variant == "one frame":
        take = make_take(frames=1, size=(20, 30))
    elif variant == "no depth":
        view = take.views[0]
        take = replace(take, views=(replace(view, clip=replace(view.clip, depth_m=None)),))
    elif variant == "wide":
        take = make_take(frames=3, views=1, size=(640, 120))
    sheet = contact_sheet(take, columns=3, tile_width_px=96)
    assert sheet.dtype == np.uint8
    assert sheet.shape[1] >= 900
    assert all(has_colour(sheet, query_colour(int(e))) for e in take.tracked)


def test_nothing_to_draw(take: Take):
    with pytest.raises(InputError, match="expected a view"):
        contact_sheet(replace(take, views=()))
    with pytest.raises(InputError, match="a column"):
        contact_sheet(take, columns=0)


def test_cameras_that_move_are_told(take: Take, monkeypatch: pytest.MonkeyPatch):
    written: list[str] = []
    monkeypatch.setattr("quest.viz.contact_sheet.draw_text", lambda canvas, text, xy, **kind: written.append(text))
    pose = take.views[1].clip.cam_from_world.copy()
    pose[-1, :3, :3] = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]) @ pose[-1, :3, :3]
    moving = replace(take.views[1], clip=replace(take.views[1].clip, cam_from_world=pose))
    info = replace(take.info, suite="moving")
    contact_sheet(replace(take, views=(take.views[0], moving), info=info), every=10, tile_width_px=160)
    words = " ".join(written)
    assert "camera at rest" in words
    assert "turns 90.0 deg" in words
    assert "suite moving" in words
    assert "frame 80" in words  # the ninth frame that is here is the 81st


def test_sheet_of_takes(take: Take):
    other = make_take(frames=3, views=1, size=(48, 64), seed=1)
    sheet = takes_sheet([take, other], title="two takes", columns=4, tile_width_px=64)
    assert sheet.dtype == np.uint8
    for e in take.tracked:
        assert has_colour(sheet, query_colour(int(e)))
    assert len(takes_sheet([take], title="one", tile_width_px=64)) < len(sheet)
    for takes in ([], [replace(take, views=())]):
        with pytest.raises(InputError, match="expected takes with views"):
            takes_sheet(takes, title="none")
