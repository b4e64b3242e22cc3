"""One renderer for all tests that render: the first picture of a process compiles shaders for many seconds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from quest.sim.objects import SimObject
    from quest.sim.renderer import Renderer
    from quest.types import Take


@pytest.fixture(scope="session")
def renderer() -> Renderer:
    from quest.sim.renderer import Renderer

    return Renderer()


@pytest.fixture(scope="session")
def cabinet(tmp_path_factory: pytest.TempPathFactory) -> SimObject:
    """The hand-written cabinet: a drawer with a handle, a door without."""
    from quest.sim.objects import load_object
    from tests.sim.small_objects import write_cabinet

    return load_object(write_cabinet(Path(tmp_path_factory.mktemp("objects")) / "cabinet"))


@pytest.fixture(scope="session")
def chest(tmp_path_factory: pytest.TempPathFactory) -> SimObject:
    """Two drawers with handles."""
    from quest.sim.objects import load_object
    from tests.sim.small_objects import CARCASS, DRAWER, write_object

    lower = replace(DRAWER, name="lower", origin=(0.02, 0, 0.25))
    return load_object(write_object(Path(tmp_path_factory.mktemp("objects")) / "chest", CARCASS, DRAWER, lower))


@pytest.fixture(scope="session")
def take(cabinet: SimObject, renderer: Renderer) -> Take:
    """A level-2 take of it, seen twice; every third frame."""
    from quest.sim.generate import generate_take
    from quest.sim.settings import TakeSettings

    settings = TakeSettings(views=2, size=96, every=3, frames_per_joint=24)
    return generate_take(cabinet, 2, 3, renderer=renderer, settings=settings, provenance={"commit": "none"})
