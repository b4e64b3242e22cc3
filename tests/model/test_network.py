"""The assembled network: what may and what may not influence an answer."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from quest.model.affordance import AffordanceMap
from quest.model.decoder import Anchor, Prediction, sample_grid
from quest.model.discovery import find_peaks
from quest.model.network import UNKNOWN_INTENT, UNKNOWN_LABEL, QuestNetwork
from quest.model.observation import FrameBatch
from quest.types import INTENTS, LABELS
from tests.tiny import DEFAULT, make_frames, make_network
from tests.tolerances import NETWORK, NETWORK_DEEP


@pytest.fixture(autouse=True)
def _no_grad():
    with torch.no_grad():
        yield


def bound(network: QuestNetwork, frames: FrameBatch, *, queries: int = 3, seed: int = 0) -> Anchor:
    """Queries bound at the first frame."""
    generator = torch.Generator().manual_seed(seed)
    uv = torch.rand(len(frames.scale), queries, 2, generator=generator)
    label = torch.arange(queries).expand(len(uv), -1) % (UNKNOWN_LABEL + 1)
    first = frames.during(slice(0, 1))
    uv_px = uv[:, None] * network.config.encoder.image_size
    point = first.to_reference(uv_px, first.near_depth_at(uv_px)).squeeze(1)
    return network.bind(network.observe(first), uv, point, label, torch.ones(uv.shape[:2], dtype=torch.bool))


def answers(network: QuestNetwork, anchor: Anchor, frames: FrameBatch) -> dict[str, Tensor]:
    prediction = network.decode(anchor, network.observe(frames))
    return {name: getattr(prediction, name) for name in Prediction.__dataclass_fields__}


def assert_same(got: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    for name in expected:
        torch.testing.assert_close(
            got[name], expected[name], **NETWORK_DEEP, equal_nan=True, msg=lambda m, n=name: f"{n}: {m}"
        )


@pytest.mark.parametrize("frames_in_window", [1, 2, 4])
def test_shapes(frames_in_window: int):
    network, frames = make_network(), make_frames(frames=frames_in_window)
    got = answers(network, bound(network, frames), frames)
    assert got["uv"].shape == (2, frames_in_window, 3, 2)
    assert got["point"].shape == (2, frames_in_window, 3, 3)
    assert got["logits"].shape == (2, frames_in_window, 3, 64)
    assert got["uv"].isfinite().all()


def test_batch_elements_are_independent():
    network, frames = make_network(), make_frames(batch=3)
    anchor = bound(network, frames)
    alone = frames.of(slice(1, 2))
    got = answers(network, Anchor(anchor.content[1:2], anchor.template[1:2], anchor.valid[1:2]), alone)
    assert_same(got, {name: value[1:2] for name, value in answers(network, anchor, frames).items()})


def test_permuting_queries_permutes_answers():
    network, frames = make_network(), make_frames()
    anchor = bound(network, frames)
    order = torch.randperm(anchor.valid.shape[1], generator=torch.Generator().manual_seed(3))
    got = answers(network, Anchor(anchor.content[:, order], anchor.template[:, order], anchor.valid[:, order]), frames)
    assert_same(got, {name: value[:, :, order] for name, value in answers(network, anchor, frames).items()})


def test_later_frames_do_not_change_earlier_answers():
    network, frames = make_network(), make_frames()
    anchor = bound(network, frames)
    other = make_frames(seed=1)
    changed = replace(
        frames,
        **{
            name: torch.cat((getattr(frames, name)[:, :2], getattr(other, name)[:, 2:]), dim=1)
            for name in ("features", "rgb", "depth_m", "cell_depth_m", "ref_from_cam")
        },
    )
    before, after = answers(network, anchor, frames), answers(network, anchor, changed)
    assert_same({n: v[:, :2] for n, v in after.items()}, {n: v[:, :2] for n, v in before.items()})
    assert not torch.allclose(before["embedding"][:, 2:], after["embedding"][:, 2:], atol=1e-4)


def test_earlier_frames_do_change_later_answers():
    network, frames = make_network(), make_frames()
    anchor = bound(network, frames)
    short = answers(network, anchor, frames.during(slice(3, 4)))
    assert not torch.allclose(answers(network, anchor, frames)["embedding"][:, 3:], short["embedding"], atol=1e-4)


def test_padding_queries_influence_nobody():
    network, frames = make_network(), make_frames()
    anchor = bound(network, frames)
    expected = answers(network, anchor, frames)
    size = anchor.template.shape[2:]
    more = Anchor(10 * torch.randn(2, 4, DEFAULT.width), torch.randn(2, 4, *size), torch.zeros(2, 4, dtype=torch.bool))
    got = answers(network, anchor.join(more), frames)
    assert_same({name: value[:, :, :3] for name, value in got.items()}, expected)
    assert all(v.isfinite().all() for n, v in got.items() if n != "point")


def test_nothing_but_padding_is_no_nan():
    network, frames = make_network(), make_frames()
    anchor = bound(network, frames)
    padding = replace(anchor, valid=torch.zeros_like(anchor.valid))
    assert answers(network, padding, frames)["uv"].isfinite().all()


def test_without_any_depth_pixels_stay_finite():
    network, frames = make_network(), make_frames(depth=False)
    got = answers(network, bound(network, frames), frames)
    assert all(value.isfinite().all() for name, value in got.items() if name != "point")
    assert got["point"].isnan().all()


def test_binding_does_not_mix_queries():
    network, frames = make_network(), make_frames()
    two, three = bound(network, frames, queries=2, seed=4), bound(network, frames, queries=2, seed=4)
    torch.testing.assert_close(two.content, three.content)
    observed = network.observe(frames.during(slice(0, 1)))
    uv, nan = torch.rand(2, 3, 2), torch.full((2, 3, 3), torch.nan)
    label, valid = torch.zeros(2, 3, dtype=torch.long), torch.ones(2, 3, dtype=torch.bool)
    together = network.bind(observed, uv, nan, label, valid).content
    alone = network.bind(observed, uv[:, 1:2], nan[:, 1:2], label[:, 1:2], valid[:, 1:2]).content
    torch.testing.assert_close(together[:, 1:2], alone, **NETWORK)


def test_label_place_and_depth_reach_the_anchor():
    network, frames = make_network(), make_frames()
    observed = network.observe(frames.during(slice(0, 1)))
    uv, point = torch.full((2, 1, 2), 0.3), torch.zeros(2, 1, 3)
    label, valid = torch.zeros(2, 1, dtype=torch.long), torch.ones(2, 1, dtype=torch.bool)
    base = network.bind(observed, uv, point, label, valid).content
    for changed in (
        network.bind(observed, uv + 0.3, point, label, valid),
        network.bind(observed, uv, point + 0.3, label, valid),
        network.bind(observed, uv, point * torch.nan, label, valid),
        network.bind(observed, uv, point, label + UNKNOWN_LABEL, valid),
    ):
        assert not torch.allclose(changed.content, base, atol=1e-3)


def test_the_answer_lies_around_the_best_cell():
    """The second look starts at the mean of the 3 x 3 cells and sees four close cells to every side."""
    network, frames = make_network(), make_frames()
    got = answers(network, bound(network, frames), frames)
    assert (got["peak"] == got["logits"].argmax(-1)).all()
    peak = torch.stack((got["peak"] % 8 + 0.5, got["peak"] // 8 + 0.5), dim=-1) / 8
    for parameter in network.head.look.out.parameters():
        torch.nn.init.zeros_(parameter)
    plain = answers(network, bound(network, frames), frames)
    assert ((plain["uv"] - peak).abs() <= (1 + 4.5 / 2) / 8 + 1e-6).all()


def test_the_second_look_compares_with_the_anchor():
    network, frames = make_network(), make_frames()
    anchor = bound(network, frames)
    other = replace(anchor, template=anchor.template.flip(0))
    before, after = answers(network, anchor, frames), answers(network, other, frames)
    assert (before["peak"] == after["peak"]).all()
    assert not torch.allclose(before["uv"], after["uv"], atol=1e-5)


def test_joints_have_unit_axes_and_bounded_spreads():
    network, frames = make_network(), make_frames()
    belief = network.joint(answers(network, bound(network, frames), frames)["embedding"])
    for axis in (belief.slide_axis, belief.turn_axis):
        torch.testing.assert_close(axis.norm(dim=-1), torch.ones(2, 4, 3))
    assert belief.log_spread.shape == belief.foot.shape == (2, 4, 3, 3)
    assert belief.log_spread.abs().max() <= 4


def test_bilinear_samples_against_a_plain_loop():
    torch.manual_seed(0)
    cells = torch.randn(2, 16, 3)
    uv = torch.tensor([[[0.5, 0.5], [0.125, 0.375], [0.3, 0.8]], [[0.0, 1.0], [0.9, 0.05], [0.44, 0.61]]])
    got = sample_grid(cells, uv, 4)
    for b in range(2):
        for k in range(3):
            x, y = (uv[b, k] * 4 - 0.5).clamp(0, 3).tolist()
            x0, y0 = min(int(x), 2), min(int(y), 2)
            total = torch.zeros(3)
            for dy in (0, 1):
                for dx in (0, 1):
                    weight = (1 - abs(x - x0 - dx)) * (1 - abs(y - y0 - dy))
                    total += weight * cells[b, (y0 + dy) * 4 + x0 + dx]
            torch.testing.assert_close(got[b, k], total, **NETWORK)


def test_slots_are_peaks_best_first_and_apart():
    network, frames = make_network(), make_frames(batch=1, frames=1)
    observed = network.observe(frames)
    peaks = find_peaks(network, frames, observed, radius_cells=1.5, mirror=False)
    assert 1 <= len(peaks.uv) <= DEFAULT.slots
    assert (peaks.logit.diff() <= 0).all()
    assert ((peaks.label >= 0) & (peaks.label < len(LABELS))).all()
    gap = torch.cdist(peaks.uv * 64, peaks.uv * 64) + 1e3 * torch.eye(len(peaks.uv))
    alike = peaks.label[:, None] == peaks.label
    other_purpose = alike & (peaks.intent[:, None] != peaks.intent)
    # Coordinates are clamped to the image after the comparison.
    inside = ((peaks.uv > 0) & (peaks.uv < 1)).all(-1)
    apart = gap >= torch.where(other_purpose, 3.0, 1.5 * 8) - 1e-3
    assert (apart | ~alike)[inside][:, inside].all()
    assert peaks.logit[0] == network.afford(frames, observed).logits.max()
    assert ((peaks.intent >= 0) & (peaks.intent < len(INTENTS))).all()


def test_one_place_to_open_and_to_lift_by_gives_two_slots(monkeypatch: pytest.MonkeyPatch):
    network, frames = make_network(), make_frames(batch=1, frames=1)
    cells, purposes = network.config.cells**2, len(INTENTS)
    logits, offset = torch.full((1, 1, cells, len(LABELS), purposes), -9.0), torch.zeros(1, 1, cells, purposes, 2)
    logits[..., 27, 2, 0], logits[..., 27, 2, 1], logits[..., 27, 1, 1] = 4.0, 3.0, 2.0
    offset[..., 27, 0, 1], offset[..., 27, 1, 1] = -0.3, 0.3
    monkeypatch.setattr(network, "afford", lambda *_: AffordanceMap(logits, offset))
    peaks = find_peaks(network, frames, network.observe(frames), radius_cells=1.5, mirror=False)
    assert (peaks.label[:2].tolist(), peaks.intent[:2].tolist()) == ([2, 2], [0, 1])
    assert (peaks.label[2], peaks.logit[2]) == (1, 2.0), "the same place under another label is a third"
    assert (peaks.logit[3:] == -9).all()
    offset[..., 1] = 0.0
    peaks = find_peaks(network, frames, network.observe(frames), radius_cells=1.5, mirror=False)
    assert peaks.intent[:2].tolist() == [0, 1], "the rims of a closed laptop may fall into one pixel"
    logits[..., 27, 0, :], logits[..., 27, 2, :] = logits[..., 27, 2, :].clone(), -9.0
    peaks = find_peaks(network, frames, network.observe(frames), radius_cells=1.5, mirror=False)
    assert (peaks.label[0], peaks.intent[0]) == (0, 0)
    assert (peaks.logit[peaks.label == 0][1:] == -9).all(), "of a handle in one pixel only the better is kept"
    assert peaks.logit.tolist()[:3] == [4.0, 2.0, -9.0]


def test_a_network_without_intents_and_trunk_reads_its_map_off_its_cells():
    network, frames = make_network(intents=False, map_layers=0), make_frames(batch=1, frames=1)
    peaks = find_peaks(network, frames, network.observe(frames), radius_cells=1.5)
    assert len(peaks.uv) >= 1
    assert (peaks.intent == UNKNOWN_INTENT).all()
