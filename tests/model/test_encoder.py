"""The encoder, and initial weights of other sizes."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from quest.errors import WeightsError
from quest.model.encoder import Encoder, EncoderConfig, resize_patch_kernel, resize_position
from quest.train.dataset import load_initial_encoder
from tests.tolerances import NETWORK

CONFIG = EncoderConfig(image_size=64, patch_size=16, width=32, depth=1, heads=2)


def initial(**changes: Tensor | None) -> dict[str, Tensor]:
    """Weights of an encoder with 14-pixel patches on a 5 x 5 grid."""
    torch.manual_seed(1)
    other = Encoder(EncoderConfig(image_size=70, patch_size=14, width=32, depth=1, heads=2))
    state = {**other.state_dict(), **changes}
    return {name: tensor for name, tensor in state.items() if tensor is not None}


def smooth_images(count: int, size: int) -> Tensor:
    torch.manual_seed(2)
    return F.interpolate(torch.randn(count, 3, 4, 4), size=(size, size), mode="bicubic", align_corners=False)


def test_tokens_come_row_by_row():
    torch.manual_seed(0)
    encoder = Encoder(EncoderConfig(image_size=64, patch_size=16, width=32, depth=0, heads=2)).eval()
    rgb = torch.randint(0, 256, (1, 64, 64, 3), dtype=torch.uint8)
    changed = rgb.clone()
    changed[:, 16:32, 48:] = 255 - changed[:, 16:32, 48:]
    differs = (encoder(rgb) != encoder(changed)).any(-1)[0]
    assert differs.nonzero().flatten().tolist() == [1 * 4 + 3]


def test_colours_are_normalised():
    encoder = Encoder(CONFIG)
    seen = []
    encoder.patch.register_forward_pre_hook(lambda module, inputs: seen.append(inputs[0]))
    encoder(torch.full((1, 64, 64, 3), 255, dtype=torch.uint8))
    expected = (1 - torch.tensor([0.485, 0.456, 0.406])) / torch.tensor([0.229, 0.224, 0.225])
    torch.testing.assert_close(seen[0][0, :, 5, 7], expected)


def test_tokens_after_several_blocks_of_pictures_of_any_size():
    """Each normalised by itself; the last of a picture of the configured size is what the encoder says of it."""
    torch.manual_seed(0)
    encoder = Encoder(EncoderConfig(image_size=64, patch_size=16, width=32, depth=3, heads=2)).eval()
    rgb = torch.randint(0, 256, (2, 64, 64, 3), dtype=torch.uint8)
    with torch.no_grad():
        read = encoder.depths(rgb.permute(0, 3, 1, 2) / 255, (0, 2))
        assert read.shape == (2, 64, 4, 4)
        torch.testing.assert_close(read[:, 32:].flatten(2).transpose(1, 2), encoder(rgb), **NETWORK)
        torch.testing.assert_close(encoder(rgb)[1:], encoder(rgb[1:]), **NETWORK)
        assert not torch.allclose(read[:, :32], read[:, 32:], atol=0.1)
        torch.testing.assert_close(read[:, :32].mean(1), torch.zeros(2, 4, 4), **NETWORK)
        assert encoder.depths(torch.rand(1, 3, 32, 96), (1,)).shape == (1, 32, 2, 6)


def test_same_sizes_stay_as_they_are():
    kernel, position = torch.randn(8, 3, 16, 16), torch.randn(1, 17, 8)
    assert resize_patch_kernel(kernel, 16) is kernel
    assert resize_position(position, (4, 4)) is position


@pytest.mark.parametrize(("old", "new", "tolerance"), [(14, 16, 1e-3), (16, 14, 0.05), (8, 16, 1e-3)])
def test_a_resized_kernel_answers_as_before(old: int, new: int, tolerance: float):
    """Exact where the patch grows (up-sampling loses nothing), close on smooth patches where it shrinks."""
    torch.manual_seed(0)
    kernel = F.interpolate(torch.randn(6, 3, 4, 4), size=(old, old), mode="bicubic", align_corners=False)
    patch = smooth_images(20, old)
    resized = F.interpolate(patch, size=(new, new), mode="bicubic", align_corners=False)
    before = F.conv2d(patch, kernel).flatten(1)
    after = F.conv2d(resized, resize_patch_kernel(kernel, new)).flatten(1)
    assert (after - before).norm() / before.norm() < tolerance


def test_resized_positions_keep_the_class_token_and_the_layout():
    y, x = torch.meshgrid(torch.linspace(0, 1, 9), torch.linspace(0, 1, 9), indexing="ij")
    square = torch.stack((x, y), dim=-1).reshape(1, 81, 2)
    position = torch.cat((torch.tensor([[[7.0, 8.0]]]), square), dim=1)
    resized = resize_position(position, (5, 5))
    assert resized.shape == (1, 26, 2)
    assert resized[0, 0].tolist() == [7.0, 8.0]
    grid = resized[0, 1:].reshape(5, 5, 2)
    assert (grid[:, 1:, 0] > grid[:, :-1, 0]).all()
    assert (grid[1:, :, 1] > grid[:-1, :, 1]).all()
    torch.testing.assert_close(grid[2, 2], torch.tensor([0.5, 0.5]))
    assert resize_position(position, (3, 7)).shape == (1, 22, 2)


def test_weights_of_another_patch_size_load():
    encoder, state = Encoder(CONFIG), initial()
    encoder.load_initial(state)
    assert encoder.position.shape == (1, 17, 32)
    torch.testing.assert_close(encoder.norm.weight, state["norm.weight"])
    torch.testing.assert_close(encoder.state_dict()["blocks.0.qkv.weight"], state["blocks.0.qkv.weight"])


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"patch.weight": None}, "patch.weight"),
        ({"position": None}, "position"),
        ({"norm.bias": None}, "norm.bias"),
        ({"decoder.weight": torch.zeros(1)}, "decoder.weight"),
        ({"norm.bias": torch.zeros(31)}, "31"),
        ({"patch.weight": torch.zeros(24, 3, 14, 14)}, "24"),
        ({"patch.weight": torch.zeros(32, 3, 14, 13)}, "13"),
        ({"patch.weight": torch.zeros(32, 3)}, "square"),
        ({"position": torch.zeros(1, 18, 32)}, "18"),
        ({"position": torch.zeros(17, 32)}, "square"),
        ({"position": torch.zeros(1, 1, 32)}, "square"),
    ],
)
def test_foreign_weights_are_refused(changes: dict[str, Tensor | None], named: str):
    with pytest.raises(WeightsError, match=named):
        Encoder(CONFIG).load_initial(initial(**changes))


def test_encoder_files_that_cannot_be_used(tmp_path: Path):
    from safetensors.torch import save_file

    from tests.paper.tiny import make_paper

    network = make_paper()
    with pytest.raises(WeightsError, match="import-encoder"):
        load_initial_encoder(network, tmp_path / "none.safetensors")
    torn = tmp_path / "torn.safetensors"
    save_file(initial(), torn)
    load_initial_encoder(network, torn)
    torn.write_bytes(torn.read_bytes()[:-100])
    with pytest.raises(WeightsError, match="torn"):
        load_initial_encoder(network, torn)
