"""In which precision networks compute where."""

from __future__ import annotations

import torch

_AMPERE = (8, 0)


def fast_bfloat16(device: torch.device) -> bool:
    """Whether bfloat16 is faster than float32 there; a GPU that only emulates it does not count."""
    if device.type == "cuda":
        if torch.version.hip is not None:
            return torch.cuda.is_bf16_supported()
        return torch.cuda.get_device_capability(device) >= _AMPERE
    if device.type != "cpu" or not torch.backends.mkldnn.is_available():
        return False
    # Where the processor lacks the instructions, oneDNN emulates them at a quarter of float32's speed.
    return bool(torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported())
