"""Stage find: marks, views, targets, losses, and that it learns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from quest.data.boxed_pictures import BoxedPicture, may_choose
from quest.errors import ConfigError
from quest.model.finder import COARSE_PX, FINE_PX, OPENINGS, PANELS, PLACES, FinderMaps
from quest.model.found import Odds, read_off, shared
from quest.model.second_look import SecondLook, SecondLooks
from quest.train.dataset import UNSTATED
from quest.train.finding.dataset import FinderData, open_finder_data
from quest.train.finding.marks import KINDS, UNKNOWN, Marks
from quest.train.finding.objective import StageFind, _focal, _giou
from quest.train.finding.sampler import FinderInputs, FinderSampler, FinderTruth, targets
from quest.train.finding.settings import VIEW_PX, FinderSamplerConfig
from quest.train.finding.takes import marks_of
from quest.train.finding.views import PictureCache, ViewCache, draw_view, of_pictures, read_view, read_whole
from tests.synthetic import make_take
from tests.tiny import make_finder

BLIND = SecondLooks((8, 8), strides=(FINE_PX, COARSE_PX)).eval()
"""Has learned nothing, and changes no box."""
GRIP, CABINET = KINDS.index("grip"), KINDS.index("cabinet")


def make_marks() -> Marks:
    """A handle on a cabinet door that turns about its left edge, and a rim."""
    return Marks(
        kind=np.array([GRIP, CABINET, KINDS.index("rim")]),
        box_px=np.array([[80.0, 40, 120, 56], [20, 10, 220, 210], [220, 110, 220, 110]]),
        point_px=np.array([[100.0, 48], [120, 110], [220, 110]]),
        knob=np.array([0, UNKNOWN, UNKNOWN]),
        lift=np.array([0, UNKNOWN, 0]),
        opening=np.array([UNKNOWN, OPENINGS.index("left"), UNKNOWN]),
        known=np.ones(len(KINDS), bool),
    )


def test_mirrored_marks_open_the_other_way_round() -> None:
    marks = make_marks().warped(np.array([-1.0, 1.0]), np.array([256.0, 0.0]), (256, 256))
    assert OPENINGS[marks.opening[1]] == "right"
    np.testing.assert_allclose(marks.box_px[0], [136, 40, 176, 56])
    np.testing.assert_allclose(marks.point_px[2], [36, 110])


def test_marks_whose_point_is_cut_off_are_left_out() -> None:
    marks = make_marks().warped(np.ones(2), np.array([-115.0, 0.0]), (256, 256))
    assert [KINDS[k] for k in marks.kind] == ["cabinet", "rim"]
    np.testing.assert_allclose(marks.box_px[0], [-95, 10, 105, 210])


def test_what_is_cut_off_ends_at_the_cut() -> None:
    whole, cut = (targets(make_marks().warped(np.ones(2), np.array([x, 0.0]), (256, 256)), 256) for x in (0.0, -60.0))
    for maps, left in ((whole, 20.0), (cut, 0.0)):
        row, column = np.argwhere(maps["panel_weight"] > 0)[0]
        assert (column + 0.5) * 16 - maps["panel_extent"][0, row, column] == pytest.approx(left)
    assert cut["panel"][0, 110 // 16, 80 // 16] == 1  # the middle of what is seen of it, 0 to 160 pixels


def test_maps_of_perfect_targets_read_back_as_the_marks() -> None:
    marks = make_marks()
    maps = targets(marks, 256)
    found = read_off(_perfect(maps), BLIND, scale=np.array([2.0, 2.0]), size=(128, 128), odds=Odds())
    likely = found.select(found.logit > 0)
    assert sorted(likely.labels) == ["handle", "rim"]
    grip = likely.labels.index("handle")
    np.testing.assert_allclose(likely.uv_px[grip], [50, 24], atol=2)
    np.testing.assert_allclose(likely.box_px[grip], [40, 20, 60, 28], atol=0.1)
    panel = likely.panel[grip]
    np.testing.assert_allclose(likely.panels.box_px[panel], [10, 5, 110, 105], atol=0.1)
    assert OPENINGS[likely.panels.opening_p[panel].argmax()] == "left"


def test_a_panel_without_a_grip_is_taken_hold_of_by_its_front_or_by_the_edge_across_its_hinge() -> None:
    """Unless a likelier one takes its place."""
    box = np.array([[20.0, 10, 120, 210], [140, 20, 240, 60], [80.0, 40, 120, 56], [20, 140, 110, 200]])
    marks = Marks(
        kind=np.array([CABINET, CABINET, GRIP, CABINET]),
        box_px=box,
        point_px=(box[:, :2] + box[:, 2:]) / 2,
        knob=np.array([UNKNOWN, UNKNOWN, 0, UNKNOWN]),
        lift=np.full(4, UNKNOWN),
        opening=np.array([OPENINGS.index(o) for o in ("left", "slides", "left", "slides")]),
        known=np.ones(len(KINDS), bool),
    )

    def found(marks: Marks, odds: Odds) -> dict[str, list[float]]:
        maps = _perfect(targets(marks, 256))
        maps.panel[maps.panel > 0] = 4.0
        maps.panel[0, CABINET - len(PLACES), 170 // 16, 65 // 16] = 3.0
        seen = read_off(maps, BLIND, scale=np.ones(2), size=(256, 256), odds=odds)
        likely = seen.select(seen.logit > 0)
        return {label: uv.tolist() for label, uv in zip(likely.labels, likely.uv_px, strict=True)}

    door = marks.only(np.arange(4) != 2)
    assert found(marks, Odds()).keys() == {"handle", "front"}
    assert found(door, Odds()) == {"front": [190, 40], "rim": [120, 110]}
    assert "front" not in found(door, Odds(panel_bias=-9.0))


def test_a_door_that_two_cells_answer_for_with_other_edges_is_found_once() -> None:
    class Sure(SecondLook):
        def forward(
            self, features: Sequence[torch.Tensor], box_px: torch.Tensor, picture: torch.Tensor
        ) -> torch.Tensor:
            return torch.tensor([[20.0, 10, 220, 210]]).repeat(len(box_px), 1)

    maps = _perfect(targets(make_marks().only(np.array([False, True, False])), 256))
    maps.panel[maps.panel > 0] = 4.0
    row, column = 3, 3
    maps.panel[0, CABINET - len(PLACES), row, column] = 3.0
    maps.panel_extent[0, :, row, column] = 40.0
    sure = SecondLooks((8, 8), strides=(FINE_PX, COARSE_PX)).eval()
    sure.panel = Sure((8, 8), strides=(FINE_PX, COARSE_PX))
    for second, count in ((BLIND, 2), (sure, 1)):
        panels = read_off(maps, second, scale=np.ones(2), size=(256, 256), odds=Odds()).panels
        assert (panels.logit > 0).sum() == count


def test_a_bar_that_reaches_far_out_of_the_picture_has_its_label_from_inside() -> None:
    maps = _perfect(targets(make_marks(), 256))
    maps.longest[0, 8, 0], maps.knob[0, :, 1:] = 99.0, 9.0  # what is not at the edge says knob
    maps.longest_extent[0, :, 8, 0] = torch.tensor([400.0, 8, 8, 8])
    found = read_off(maps, BLIND, scale=np.ones(2), size=(256, 256), odds=Odds())
    assert found.labels[0] == "handle"
    assert found.uv_px[0, 0] == 0


def _perfect(maps: dict[str, np.ndarray]) -> FinderMaps:
    truth = {name: torch.from_numpy(value)[None] for name, value in maps.items()}

    def logit(name: str) -> torch.Tensor:
        return 20 * (truth[name] + truth[f"{name}_share"] - 0.9)

    opening = torch.nn.functional.one_hot(truth["opening"].clamp(min=0), len(OPENINGS)).permute(0, 3, 1, 2).float()
    return FinderMaps(
        logit("place"), -torch.ones_like(truth["weight"]), -torch.ones_like(truth["weight"]), truth["extent"],
        logit("longer")[:, 0], truth["longer_extent"], logit("longest")[:, 0], truth["longest_extent"],
        logit("panel"), truth["panel_extent"], 10 * opening,
        torch.zeros(1, 8, *truth["weight"].shape[1:]), torch.zeros(1, 8, *truth["panel_weight"].shape[1:]),
    )  # fmt: skip


def test_what_is_not_labelled_costs_nothing() -> None:
    logit, nothing = torch.full((1, 2, 8, 8), 3.0), torch.zeros(1, 2, 8, 8)
    assert float(_focal(logit, nothing, nothing, torch.tensor([[False, False]]))) == 0
    assert float(_focal(logit, nothing, nothing, torch.tensor([[True, False]]))) > 1


def test_any_place_on_the_inner_half_of_a_bar_is_right_on_the_level_of_its_length() -> None:
    box = np.array(
        [[20.0, 96, 220, 112], [120, 200, 132, 212], [140, 150, 180, 158]]
    )  # a long bar, a knob, both levels
    middle = (box[:, :2] + box[:, 2:]) / 2
    marks = replace(make_marks(), kind=np.zeros(3, int), box_px=box, point_px=middle, knob=np.zeros(3, int),
                    lift=np.zeros(3, int), opening=np.full(3, UNKNOWN))  # fmt: skip
    maps = targets(marks, 256)
    row = maps["longest"][0, 104 // 16]
    assert (row[80 // 16 : 160 // 16] == 1).all()
    assert row[0] < 0.3
    for name, count in (("place", 2), ("longer", 1), ("longest", 1)):
        assert maps[f"{name}_share"][0].sum() == pytest.approx(count)
    assert maps["place"][0, 104 // 4].max() == 0  # half as long again is no excuse for a short handle
    assert maps["longer"][0, 11:15].max() == 1  # nobody minds a bar a little longer


def test_extents_of_the_same_box_cost_nothing_and_others_more() -> None:
    true = torch.rand(2, 4, 6, 6) * 20 + 1
    weight = torch.rand(2, 6, 6)
    assert float(_giou(true, true, weight)) == pytest.approx(0, abs=1e-5)
    assert float(_giou(2 * true, true, weight)) == pytest.approx(0.75, abs=1e-4)


def test_views_are_squares_whose_boxes_stay_on_what_they_marked() -> None:
    rgb = np.zeros((240, 320, 3), np.uint8)
    rgb[100:140, 200:260] = 255
    marks = replace(make_marks().only(np.array([True, False, False])), box_px=np.array([[200.0, 100, 260, 140]]),
                    point_px=np.array([[230.0, 120]]))  # fmt: skip
    for seed in range(8):
        view, moved = draw_view(rgb, marks, np.random.default_rng(seed))
        assert view.shape == (VIEW_PX, VIEW_PX, 3)
        for box in moved.box_px.clip(0, VIEW_PX):
            x0, y0, x1, y1 = box.round().astype(int)
            white = view.max(axis=-1) > view[(y0 + y1) // 2, (x0 + x1) // 2].max() / 2
            assert white[y0 + 3 : y1 - 3, x0 + 3 : x1 - 3].all()
            edge = white[max(y0 - 8, 0) : y1 + 8, max(x0 - 8, 0) : x1 + 8]
            assert edge.sum() < 1.15 * max((x1 - x0) * (y1 - y0), 1) + 100


def test_marks_of_a_take_say_what_is_seen() -> None:
    take = make_take()
    marks = marks_of(take, take.views[0], 0)
    seen = [e for i, e in enumerate(take.info.entities) if take.views[0].visible[0, i]]
    assert (marks.kind < len(PLACES)).sum() == len(seen)
    assert marks.known[: len(PLACES)].all()
    for box, point in zip(marks.box_px, marks.point_px, strict=True):
        assert (point >= box[:2]).all()
        assert (point <= box[2:]).all()


def test_pictures_without_known_classes_are_refused() -> None:
    picture = BoxedPicture(Path("a.jpg"), ("cat",), np.array([[0.0, 0, 1, 1]]))
    with pytest.raises(ConfigError, match="handle"):
        of_pictures([picture], only=[True])


def make_set(folder: Path, *, name: str, value: int, licence: str = "") -> Path:
    """A labelled set of ten pictures ``0.png`` ... with one box each."""
    (folder / "pictures").mkdir(parents=True)
    lines = ["file,class,x0,y0,x1,y1,licence"]
    for i in range(10):
        Image.fromarray(np.full((60, 80, 3), value + i, np.uint8)).save(folder / "pictures" / f"{i}.png")
        lines.append(f"{i}.png,{name},10,10,40,30,{licence}")
    (folder / "labels.csv").write_text("\n".join(lines) + "\n")
    return folder


@pytest.mark.slow
def test_sets_of_pictures_keep_apart(tmp_path: Path) -> None:
    """Files of one name in two sets are two pictures; what one set has labelled says nothing of the other."""
    handles = make_set(tmp_path / "a" / "same", name="handle", value=10, licence="CC BY 4.0")
    knobs = make_set(tmp_path / "b" / "same", name="knob", value=200)
    network = make_finder()

    def opened(*, free: bool = False) -> FinderData:
        return open_finder_data(
            network, pictures=[handles, knobs], free=free, stores=[], validation_stores=[], cache=tmp_path / "cache",
            views=1, frames=1, config=FinderSamplerConfig(), report=lambda done, total: None,
        )  # fmt: skip

    data = opened()
    views = [read_view(path) for path in data.training.pictures]
    assert len(set(data.training.pictures)) == 2 * sum(not may_choose(f"{i}.png") for i in range(10))
    told = {int(knob) for view in views for knob in view.marks.knob}
    assert told == {UNKNOWN, 1}  # a set without knobs has grips of either kind
    assert data.sources == {UNSTATED}
    assert opened(free=True).sources == set()
    before = data.training.pictures[0]
    (handles / "labels.csv").write_text((handles / "labels.csv").read_text().replace("10,10,40,30", "12,10,40,30"))
    assert before not in opened().training.pictures  # other labels, other views


def test_pictures_are_kept_no_larger_than_a_view_shows_them(tmp_path: Path) -> None:
    large, small = tmp_path / "large.png", tmp_path / "small.png"
    Image.fromarray(np.zeros((1200, 2400, 3), np.uint8)).save(large)
    Image.fromarray(np.zeros((60, 80, 3), np.uint8)).save(small)
    pictures = [BoxedPicture(path, ("handle",), np.array([[20.0, 10, 40, 30]])) for path in (large, small)]
    kept = [read_whole(PictureCache(tmp_path).build(s)) for s in of_pictures(pictures, only=[True, True])]
    assert [rgb.shape for rgb, _ in kept] == [(600, 1200, 3), (60, 80, 3)]
    np.testing.assert_allclose(kept[0][1].box_px, [[10, 5, 20, 15]])
    np.testing.assert_allclose(kept[1][1].box_px, [[20, 10, 40, 30]])


def test_boxes_without_an_area_share_nothing() -> None:
    flat, box = np.array([5.0, 5, 5, 9]), np.array([[0.0, 0, 10, 10], [5, 5, 5, 9]])
    with np.errstate(all="raise"):
        assert shared(flat, box).tolist() == [0, 0]


def test_a_network_has_only_so_many_blocks_to_learn() -> None:
    with pytest.raises(ConfigError, match="blocks"):
        StageFind(make_finder(), learned_blocks=13)


def test_a_second_look_learns_the_edges_of_a_blob() -> None:
    """Boxes that are moved by chance come back to where the features are 1."""
    torch.manual_seed(0)
    look, rng = SecondLook((8,), strides=(FINE_PX,)), np.random.default_rng(0)
    optimizer = torch.optim.AdamW(look.parameters(), lr=4e-3)

    def drawn(count: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        low = rng.uniform(40, 120, (count, 2))
        box = torch.tensor(np.concatenate((low, low + rng.uniform(20, 90, (count, 2))), axis=1)).float()
        cell = (torch.arange(64) + 0.5) * FINE_PX
        within = [((cell >= box[:, k, None]) & (cell <= box[:, k + 2, None])).float() for k in (0, 1)]
        features = (within[1][:, :, None] * within[0][:, None])[:, None].repeat(1, 8, 1, 1)
        return features, box, box + 8 * torch.randn(count, 4)

    for _ in range(120):
        features, box, first = drawn(12)
        loss = (look([features], first, torch.arange(12)) - box).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    features, box, first = drawn(64)
    look.eval()
    with torch.no_grad():
        second = look([features], first, torch.arange(64))
        shuffled = torch.randperm(64)
        again = look([features], first[shuffled], shuffled)
    assert float((second - box).abs().mean()) < 0.5 * float((first - box).abs().mean())
    torch.testing.assert_close(again, second[shuffled])


def test_the_second_look_learns_alone(tmp_path: Path) -> None:
    network = make_finder()
    stage = StageFind(network, second_alone=True)
    maps = {name: torch.from_numpy(value)[None] for name, value in targets(make_marks(), 256).items()}
    inputs = FinderInputs(torch.randint(0, 256, (1, 3, 256, 256), dtype=torch.uint8), None)
    losses = stage.losses(inputs, FinderTruth(**maps))
    assert list(losses) == list(stage.weights) == ["second"]
    losses["second"].backward()
    learned = {name for name, p in network.named_parameters() if p.grad is not None}
    assert learned == {name for name, _ in network.named_parameters() if name.startswith("second.")}
    assert len(stage.trained()) == len(learned)
    with pytest.raises(ConfigError, match="alone"):
        FinderSamplerConfig(second_alone=True, learned_blocks=2)


@pytest.mark.slow
@pytest.mark.parametrize("learned_blocks", [0, 2])
def test_a_finder_learns_a_white_handle(tmp_path: Path, learned_blocks: int) -> None:
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    pictures = []
    (tmp_path / "set" / "pictures").mkdir(parents=True)
    for i in range(2):
        rgb = np.full((480, 640, 3), 60, np.uint8)
        x, y = rng.integers(100, 400, 2).tolist()
        rgb[y : y + 30, x : x + 90] = 255
        path = tmp_path / "set" / "pictures" / f"{i}.png"
        Image.fromarray(rgb).save(path)
        pictures.append(BoxedPicture(path, ("handle",), np.array([[x, y, x + 90, y + 30]], float)))
    network = make_finder()
    sources = of_pictures(pictures, only=[True, True])
    if learned_blocks:
        paths = [PictureCache(tmp_path / "cache").build(source) for source in sources]
    else:
        views = ViewCache(tmp_path / "cache", network)
        paths = [path for source in sources for path in views.build(source, views=2)]
        assert paths == [path for source in sources for path in views.build(source, views=2)]
    sampler = FinderSampler(paths, [], FinderSamplerConfig(batch=2, cut_px=320, learned_blocks=learned_blocks))
    assert sampler.view(paths[0], seed=0).rgb.shape == (VIEW_PX, VIEW_PX, 3)
    stage = StageFind(network, learned_blocks=learned_blocks)
    transformer = [p for name, p in network.named_parameters() if name.startswith("encoder.")]
    assert sum(p.numel() for p in stage.refined()) == learned_blocks * sum(
        p.numel() for p in network.encoder.blocks[0].parameters()
    )
    before = [p.detach().clone() for p in transformer]
    for p in network.parameters():
        p.requires_grad_(any(p is other for other in stage.trained()))
    optimizer = torch.optim.AdamW(stage.trained(), lr=2e-3)
    first = last = 0.0
    network.train()
    for _ in range(12):
        frames, truth = sampler.load(sampler.plan(rng))
        assert isinstance(truth, FinderTruth)
        losses = stage.losses(frames, truth)
        total = sum(stage.weights[name] * value for name, value in losses.items())
        assert isinstance(total, torch.Tensor)
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        value = float(total.detach())
        first, last = first or value, value
    assert last < 0.8 * first
    moved = [not torch.equal(old, new) for old, new in zip(before, transformer, strict=True)]
    assert sum(moved) == len(stage.refined())
    scores = stage.validate(sampler, batches=1, device=torch.device("cpu"))
    assert scores.present == len(paths[:2]) if not learned_blocks else scores.present <= 2
    assert 0 <= scores.precision <= 1
    assert all(name in PANELS or name in PLACES for name in KINDS)
