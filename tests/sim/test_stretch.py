"""Stretched objects: closed they are the object with other proportions, and they move rigidly."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from quest.errors import ConfigError, ObjectError
from quest.sim.articulation import apply
from quest.sim.generate import generate_take
from quest.sim.objects import SimObject, load_object
from quest.sim.renderer import Renderer
from quest.sim.settings import TakeSettings
from quest.sim.stretch import draw_stretch, stretched
from tests.sim.small_objects import CARCASS, DOOR, DRAWER, Link, in_world, write_object

FACTORS = np.array([0.8, 1.5, 1.1])


def test_closed_and_along_slides_everything_is_where_the_factors_put_it(cabinet: SimObject) -> None:
    before, after = cabinet.articulation, stretched(cabinet, FACTORS).articulation
    for share in (0.0, 0.4, 1.0):
        opened = np.array([share, 0.0])  # the drawer alone
        np.testing.assert_allclose(
            after.world_points(after.rest + opened * [j.opening() for j in after.joints]),
            FACTORS * before.world_points(before.rest + opened * [j.opening() for j in before.joints]),
            atol=1e-9,
        )
    assert after.joints[0].opening() == pytest.approx(FACTORS[0] * before.joints[0].opening())
    assert after.joints[1].opening() == before.joints[1].opening()


def test_what_turns_stays_rigid_and_keeps_its_hinge(cabinet: SimObject) -> None:
    after = stretched(cabinet, FACTORS).articulation
    closed, opened = (after.poses(np.array([0.0, q]))[2] for q in (0.0, 1.2))
    points = after.body_points[2]
    distances = [np.linalg.norm(p[:, None] - p[None], axis=-1) for p in (apply(m, points) for m in (closed, opened))]
    np.testing.assert_allclose(*distances, atol=1e-9)
    old = cabinet.articulation
    hinge, new = (a.axes(a.poses(a.rest))[1] for a in (old, after))
    np.testing.assert_allclose(new, [*FACTORS * hinge[:3], *hinge[3:]], atol=1e-9)


def test_entities_and_sizes_go_with_the_object(cabinet: SimObject) -> None:
    after = stretched(cabinet, FACTORS)
    for old, new in zip(cabinet.entities, after.entities, strict=True):
        np.testing.assert_allclose(in_world(after, new), FACTORS * in_world(cabinet, old), atol=1e-9)
        assert (new.name, new.parts) == (old.name, old.parts)
    assert after.entities[0].travel_m == pytest.approx(FACTORS[0] * cabinet.entities[0].travel_m)
    assert after.half_diagonal_m == pytest.approx(np.linalg.norm(FACTORS * cabinet.articulation.extent_m) / 2)


def test_meshes_are_drawn_with_the_scale_that_their_surface_has(cabinet: SimObject) -> None:
    for old, new in zip(cabinet.articulation.parts, stretched(cabinet, FACTORS).articulation.parts, strict=True):
        assert new.mesh is not None
        raw = apply(np.linalg.inv(old.body_from_part), old.surface.vertices) / old.scale
        drawn = apply(new.body_from_part, raw * new.scale)
        np.testing.assert_allclose(drawn, new.surface.vertices, atol=1e-9)


def test_what_lies_askew(tmp_path: Path) -> None:
    tilted = Link("tilted", CARCASS.boxes, parent="body", yaw=0.5)
    thing = stretched(load_object(write_object(tmp_path / "askew", CARCASS, tilted, DRAWER)), FACTORS)
    assert sum(part.mesh is None for part in thing.articulation.parts) == len(tilted.boxes)
    # A door that is modelled half open turns about an oblique axis: nobody can say how it is stretched.
    oblique = replace(DOOR, axis=(0.0, -0.6, -0.8), limits=(-0.7, 0.8))
    leaning = load_object(write_object(tmp_path / "oblique", CARCASS, DRAWER, oblique))
    joints = (leaning.articulation.joints[0], replace(leaning.articulation.joints[1], rest=0.4))
    leaning = replace(leaning, articulation=replace(leaning.articulation, joints=joints))
    with pytest.raises(ObjectError, match="oblique axis"):
        stretched(leaning, FACTORS)
    assert stretched(leaning, np.ones(3)).half_diagonal_m > 0


def test_factors_change_proportions_only() -> None:
    rng = np.random.default_rng(0)
    drawn = np.array([draw_stretch(rng, 1.5) for _ in range(200)])
    np.testing.assert_allclose(drawn.prod(axis=1), 1.0)
    assert (drawn.max(axis=1) / drawn.min(axis=1)).max() <= 1.5**2
    assert drawn.std(axis=0).min() > 0.1
    for wrong in (0.5, 9.0):
        with pytest.raises(ConfigError, match="stretch"):
            TakeSettings(stretch=wrong)


@pytest.mark.render
def test_takes_of_stretched_objects_differ_in_shape_and_say_so(cabinet: SimObject, renderer: Renderer) -> None:
    settings = TakeSettings(views=1, size=48, every=8, frames_per_joint=24, stretch=1.5)
    first, again, other = (generate_take(cabinet, 1, s, renderer=renderer, settings=settings) for s in (5, 5, 6))
    assert first.info == again.info
    assert first.info.half_diagonal_m != other.info.half_diagonal_m
    assert first.info.provenance["stretch"] == again.info.provenance["stretch"] != other.info.provenance["stretch"]
    assert first.info.provenance["settings"] == settings.digest
    np.testing.assert_array_equal(first.views[0].clip.rgb, again.views[0].clip.rgb)
