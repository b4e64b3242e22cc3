"""An object of plain boxes and cylinders, without mesh files, with random materials again and again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from quest.sim.generate import generate_take
from quest.sim.objects import load_object
from quest.sim.renderer import Renderer
from quest.sim.settings import TakeSettings

TOOLBOX = Path(__file__).parents[2] / "examples" / "toolbox"


@pytest.mark.render
def test_shapes_without_meshes_take_materials_in_every_scene(renderer: Renderer) -> None:
    settings = TakeSettings(views=1, size=64, every=8, broad_materials=True)
    toolbox = load_object(TOOLBOX)
    pictures = [
        generate_take(toolbox, 1, seed, renderer=renderer, settings=settings).views[0].clip.rgb[0] for seed in range(6)
    ]
    assert len({picture.tobytes() for picture in pictures}) == 6
    assert all(np.ptp(picture) > 50 for picture in pictures)
