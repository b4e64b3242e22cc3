"""Procedural objects: same seed same object, sound meshes, enough handled joints, sane geometry."""

from functools import cache

import numpy as np
import pytest
import trimesh

from quest.errors import ConfigError
from quest.sim.procedural import CATEGORIES, MIXES, catalogue, category_for_seed, make_object
from quest.sim.procedural.appliances import with_dials
from quest.sim.procedural.clutter import with_clutter
from quest.sim.procedural.handles import HANDLE_KINDS, HandleStyle, handle_part
from quest.sim.procedural.model import Dice, Link, ObjectModel
from quest.sim.procedural.shapes import Mesh, join, tube, walls

pytest.importorskip("scene_synthesizer", reason="scene-synthesizer is not installed")

build_model = cache(catalogue.build_model)

THINGS = ("eyeglasses", "sunglasses", "stapler", "bucket", "pot")
"""What is no furniture: small, turned in other ways, or held by what is not on a front."""
FURNITURE = [category for category in CATEGORIES if category not in THINGS]


def dice(seed: int) -> Dice:
    return Dice(np.random.PCG64(seed))


def starting(word: str) -> list[str]:
    return [category for category in CATEGORIES if category.startswith(word)]


def triangles(mesh: Mesh) -> np.ndarray:
    return mesh.vertices[mesh.faces].transpose(1, 0, 2)


def is_closed(mesh: Mesh) -> bool:
    """Whether every edge is walked as often in one direction as in the other, once equal corners are merged."""
    places = np.round(mesh.vertices * 1e7).astype(np.int64)
    _, same = np.unique(places @ [73856093, 19349663, 83492791], return_inverse=True)
    faces = same.reshape(-1)[mesh.faces]
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    count = len(mesh.vertices)
    return bool(np.array_equal(np.sort(edges @ [count, 1]), np.sort(edges @ [1, count])))


def moving(category: str, model: ObjectModel) -> list[Link]:
    """Links that are more than a dial, where a category has dials."""
    return [link for link in model.links if link.rest or not category.startswith("dial_")]


def all_parts(model: ObjectModel) -> list:
    return [*model.body, *(part for link in model.links for part in link.parts)]


def in_object(link: Link, mesh: Mesh, position: float = 0.0) -> np.ndarray:
    """Vertices in the object's frame with the link's joint at a position."""
    vertices, axis = mesh.vertices, np.asarray(link.axis)
    if link.kind == "prismatic":
        return vertices + np.asarray(link.origin) + position * axis
    turned = np.asarray(trimesh.transformations.rotation_matrix(position, axis))[:3, :3]
    return vertices @ turned.T + np.asarray(link.origin)


@pytest.mark.parametrize("category", CATEGORIES)
def test_models_are_always_the_same_and_their_meshes_are_sound(category: str) -> None:
    model, other = (build_model(category, seed) for seed in (0, 1))
    for old, new in zip(all_parts(model), all_parts(catalogue.build_model(category, 0)), strict=True):
        np.testing.assert_array_equal(old.mesh.vertices, new.mesh.vertices)
    first, second = (join([part.mesh for part in each.body]).vertices for each in (model, other))
    assert not np.array_equal(first, second)
    for part in (*all_parts(model), *all_parts(other)):
        a, b, c = triangles(part.mesh)
        assert is_closed(part.mesh), part.role
        assert (np.cross(a, b) * c).sum() > 0, part.role  # its volume: the faces look outwards
        along_normal = (np.cross(b - a, c - a) * part.mesh.normals[part.mesh.faces].mean(axis=1)).sum(axis=1)
        assert (along_normal > -1e-12).all(), part.role


@pytest.mark.parametrize("category", FURNITURE)
def test_furniture_has_real_sizes_opens_to_the_front_and_its_handles_stand_out_of_it(category: str) -> None:
    for model in (build_model(category, seed) for seed in (0, 1)):
        body = join([part.mesh for part in model.body])
        size = np.ptp(body.bounds, axis=0)
        assert body.bounds[0, 2] == pytest.approx(0.0, abs=0.02)
        assert 0.2 < size.max() < 2.7
        for link in moving(category, model):
            assert np.linalg.norm(link.axis) == pytest.approx(1.0)
            low, high = (np.deg2rad(79), np.deg2rad(131)) if link.kind == "revolute" else (0.1, 0.85 * size[1])
            assert low < link.upper < high
            whole = join([part.mesh for part in link.parts])
            closed, opened = (in_object(link, whole, position) for position in (0.0, link.upper))
            front, top = body.bounds[0, 1], closed[:, 2].max()
            assert opened[:, 1].min() < front - 0.05 or opened[:, 2].max() > top + 0.1
            if category in ("room_door", "toolbox", "washing_machine"):
                continue  # both faces, a lid, and a round door
            board = join([part.mesh for part in link.rest]).bounds
            for low, high in (part.mesh.bounds for part in link.grips):
                assert low[1] < board[0, 1] - 0.01  # out of the foremost face
                assert high[1] > board[0, 1] - 0.004  # no gap behind its foot
                assert high[1] < board[0, 1] + 0.06  # not sunk
                assert low[2] > board[0, 2] - 0.06
                assert high[2] < board[1, 2] + 0.06


@pytest.mark.parametrize("category", ["chest", "desk", "cabinet", "lockers", "sideboard", "wardrobe"])
def test_closed_fronts_do_not_overlap(category: str) -> None:
    for seed in range(6):
        fronts = []
        for link in build_model(category, seed).links:
            panel = next(part for part in link.parts if part.role in ("drawer_front", "door_panel"))
            fronts.append(panel.mesh.moved(link.origin).bounds[:, [0, 2]])
        for i, a in enumerate(fronts):
            assert all((np.minimum(a[1], b[1]) <= np.maximum(a[0], b[0]) + 1e-9).any() for b in fronts[:i])


@pytest.mark.parametrize(("category", "seed"), [("lockers", 5), *(("locker_bank", seed) for seed in range(3))])
def test_lockers_are_identical(category: str, seed: int) -> None:
    first, *others = build_model(category, seed).links
    assert category != "locker_bank" or (len(others) == 15 and first.grips)
    for link in others:
        for a, b in zip(first.parts, link.parts, strict=True):
            np.testing.assert_allclose(a.mesh.vertices, b.mesh.vertices, atol=1e-9)


@pytest.mark.slow
def test_half_of_the_mix_has_four_handled_joints() -> None:
    models = [build_model(category_for_seed(seed), seed) for seed in range(60)]
    handled = [[bool(link.grips) for link in model.links] for model in models]
    assert np.mean([sum(links) >= 4 for links in handled]) >= 0.5
    assert 0.6 < np.mean([grips for links in handled for grips in links]) < 0.98  # some are bare on purpose


FIRST_SIX = ["refrigerator", "cabinet", "dishwasher", "cabinet", "wall_cabinet", "wall_unit"]


def test_mixes_know_their_categories_and_are_stable() -> None:
    drawn = [category_for_seed(seed) for seed in range(600)]
    assert set(drawn) == set(MIXES["usual"])
    assert drawn[:6] == FIRST_SIX  # what seeds mean is what stores and figures were made with
    by_name = ("bare_", "long_", "busy_", "dial_", "apron_table", "sunglasses")
    everything = {name for name in CATEGORIES if not name.startswith(by_name)}
    assert {category_for_seed(seed, mix="broad") for seed in range(1000)} == everything


@pytest.mark.parametrize("category", starting("bare_"))
def test_bare_furniture_has_no_handles(category: str) -> None:
    for model in (build_model(category, seed) for seed in range(3)):
        assert model.links
        assert not any(link.grips for link in model.links)


def test_drawers_of_apron_tables_are_flat_and_between_the_legs() -> None:
    for model in (build_model("apron_table", seed) for seed in range(12)):
        (legs,), (top,) = ([p.mesh.bounds for p in model.body if p.role == role] for role in ("leg", "top"))
        for link in model.links:
            front = link.parts[0].mesh.moved(link.origin).bounds
            assert link.kind == "prismatic"
            assert legs[0, 0] < front[0, 0] < front[1, 0] < legs[1, 0]
            assert 0.5 * top[0, 2] < front[0, 2] < front[1, 2] < top[0, 2] + 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("category", starting("long_"))
def test_long_handles_run_along_their_fronts(category: str) -> None:
    links = [link for seed in range(4) for link in build_model(category, seed).links if link.grips]
    assert len(links) >= 4
    for link in links:
        (handle,) = (part.mesh.bounds for part in link.grips)
        along = 2 if link.kind == "revolute" and abs(link.axis[2]) > 0.5 else 0
        low, high = join([part.mesh for part in link.rest]).bounds[:, along]
        if high - low < 0.12:
            continue  # a strip may keep its own
        assert 0.4 < np.ptp(handle[:, along]) / (high - low) < 1.0
        assert handle[:, along].mean() == pytest.approx((low + high) / 2, abs=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("category", ["chest", "cabinet", "long_refrigerator", "drawer_oven"])
def test_clutter_adds_nothing_to_take_hold_of(category: str) -> None:
    added: set[str] = set()
    for seed in range(12):
        plain = build_model(category, seed)
        busy = with_clutter(plain, dice(seed))
        raised = busy.links[0].origin[2] - plain.links[0].origin[2]
        assert raised >= 0
        for link, other in zip(plain.links, busy.links, strict=True):
            assert (link.kind, link.axis, link.upper) == (other.kind, other.axis, other.upper)
            np.testing.assert_allclose(np.asarray(other.origin) - link.origin, (0, 0, raised), atol=1e-9)
            assert other.parts[: len(link.parts)] == link.parts
            grips = [part.mesh.bounds[:, [0, 2]] for part in link.grips]
            for part in other.parts[len(link.parts) :]:
                added.add(part.role)
                low, high = part.mesh.bounds[:, [0, 2]]
                free = all((high < a).any() or (low > b).any() for a, b in grips)
                assert free or part.role == "moulding", part.role
        added |= {part.role for part in busy.body[len(plain.body) :]}
    assert added == {"vent", "keypad", "display", "badge", "moulding", "thing", "shelf_case", "leg"}


@pytest.mark.parametrize("category", ["range", "drawer_oven", "bare_microwave", "washing_machine"])
def test_dials_turn_in_place_on_a_panel_that_is_free(category: str) -> None:
    for seed in range(8):
        plain = build_model(category, seed)
        model = with_dials(plain, dice(seed))
        assert model.links[: len(plain.links)] == plain.links
        assert not any(part.role == "dial" for part in model.body)
        panel = [part.mesh.bounds[:, 0] for part in model.body if part.role == "control_panel"][-1]
        dials = model.links[len(plain.links) :]
        assert 1 <= len(dials) <= 7
        closed = [in_object(link, part.mesh) for link in plain.links for part in link.rest]
        for dial in dials:
            assert (dial.kind, dial.parts[0].role) == ("revolute", "knob")
            shown, turned = (in_object(dial, dial.parts[0].mesh, angle) for angle in (0.0, dial.upper))
            middle, out = np.asarray(dial.origin), np.asarray(dial.axis)
            height = (shown - middle) @ out
            np.testing.assert_allclose(height, (turned - middle) @ out, atol=1e-9)
            assert -0.002 < height.min() <= 0 < 0.007 < height.max() < 0.05
            radius = np.linalg.norm(shown - middle - np.outer(height, out), axis=1).max()
            assert 0.009 < radius < 0.05
            assert panel[0] - 1e-6 <= middle[0] - radius < middle[0] + radius <= panel[1] + 1e-6
            low, high = shown[:, [0, 2]].min(axis=0), shown[:, [0, 2]].max(axis=0)
            for front in closed:  # fronts and dials do not share a place on the front
                assert not ((front[:, [0, 2]] > low) & (front[:, [0, 2]] < high)).all(axis=1).any()
        at = np.array([dial.origin for dial in dials])
        assert (np.linalg.norm(at[:, None] - at, axis=-1) + 10 * np.eye(len(at))).min() > 2 * 0.009


@pytest.mark.parametrize(
    ("category", "least", "most"), [("drawer_desk", 8, 13), ("apothecary", 12, 24), ("rack_dishwasher", 3, 3)]
)
def test_pieces_of_many_joints(category: str, least: int, most: int) -> None:
    for links in (build_model(category, seed).links for seed in range(8)):
        assert least <= len(links) <= most
        assert all(link.grips for link in links)
        assert category != "rack_dishwasher" or [k.kind for k in links] == ["revolute", "prismatic", "prismatic"]


@pytest.mark.parametrize(
    ("category", "length_m", "names"),
    [
        ("eyeglasses", (0.12, 0.18), {"link_0/rim", "link_1/rim"}),
        ("stapler", (0.1, 0.18), {"link_0/rim", "link_1/rim"}),
        ("bucket", (0.2, 0.45), {"link_0/handle"}),
        ("pot", (0.15, 0.45), {"link_0/knob", "base/handle"}),
        ("room_door", (1.9, 2.3), None),
        ("washing_machine", (0.8, 0.9), {"link_0/handle", "link_1/handle"}),
        ("toolbox", (0.4, 0.8), None),
        ("laptop", (0.25, 0.4), {"link_0/rim", "base/rim"}),
    ],
)
def test_objects_have_real_sizes_and_entities(
    category: str, length_m: tuple[float, float], names: set[str] | None
) -> None:
    for seed in (0, 1):
        thing, model = make_object(category, seed), build_model(category, seed)
        assert (thing.source, thing.object_id, thing.category) == ("procedural", f"{category}-{seed}", model.model_cat)
        assert thing.warnings == ()
        assert length_m[0] < thing.articulation.extent_m.max() < length_m[1]
        assert not thing.articulation.rest.any()  # closed at 0
        assert names is None or {e.name for e in thing.entities if e.label != "hinge"} == names
        assert len(thing.movable) == len(thing.articulation.joints) == len(model.links)
        named = [part.name.rpartition("-")[0] for part in thing.articulation.parts]
        assert named == [part.role for part in all_parts(model)]


def test_temples_fold_inwards_and_a_bail_turns_up() -> None:
    for seed in range(4):
        for link in build_model("eyeglasses", seed).links:
            rest, tip = (in_object(link, link.parts[0].mesh, angle)[:, 0] for angle in (0.0, link.upper))
            assert np.abs(tip).min() < 0.03 < np.abs(rest).min()
        (bail,) = build_model("bucket", seed).links
        low, high = (in_object(bail, bail.parts[0].mesh, angle)[:, 2].max() for angle in (0.0, bail.upper))
        assert low < bail.origin[2] + 0.06 < bail.origin[2] + 0.1 < high


@pytest.mark.parametrize("kind", HANDLE_KINDS)
@pytest.mark.parametrize("vertical", [False, True])
def test_handle_fits_the_room_it_is_given(kind: str, vertical: bool) -> None:
    style = HandleStyle(kind, 0.3, 0.012, 0.035, 1.0, "metal")  # type: ignore[arg-type]
    part = handle_part(style, at=(0.1, 0.0, 0.2), vertical=vertical, room_m=(0.15, 0.15))
    size = np.ptp(part.mesh.vertices, axis=0)
    assert max(size[0], size[2]) <= 0.15
    assert part.role == ("knob" if kind in ("knob", "disc", "block") else "handle")
    assert part.mesh.bounds[0, 1] == pytest.approx(-0.035, abs=0.012)


def test_walls_fit_between_those_before_them_and_rings_have_no_ends() -> None:
    case = walls((0, 0, 0), (1, 2, 3), (0.1, 0.1, 0.2), "-x +x -z")
    assert [np.ptp(case.vertices[24 * n : 24 * (n + 1)], axis=0).tolist() for n in range(3)] == [
        pytest.approx(size) for size in ((0.1, 2, 3), (0.1, 2, 3), (0.8, 2, 0.2))
    ]
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = tube(np.stack([np.cos(angle), np.sin(angle)], axis=1), radius_m=0.1, closed=True)
    assert is_closed(ring)
    assert len(ring.faces) == 2 * 24 * 10


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: make_object("spaceship", 0), "unknown category 'spaceship'"),
        (lambda: make_object("chest", -1), "seed >= 0"),
        (lambda: category_for_seed(0, mix="wide"), "unknown mix 'wide'; expected one of usual, broad"),
    ],
)
def test_unknown_categories_and_mixes_and_negative_seeds_are_refused(make, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        make()
