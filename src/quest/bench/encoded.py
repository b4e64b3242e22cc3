"""The encoder's answers kept in files, for many networks that share one frozen encoder."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from quest.model.weights import weights_digest
from quest.paper.network import PaperNetwork
from quest.whole_file import whole_file


def serve_cached(network: PaperNetwork, root: Path) -> None:
    """Make a network read tokens instead of computing them, as far as they are there.

    Frames are looked up by their letterboxed colours, and each is encoded once.

    Args:
        network: changed in place.
        root: folder of the files; those of one encoder are in one of its folders.
    """
    encode, folder = network.encode, root / weights_digest(network.encoder)[:12]
    folder.mkdir(parents=True, exist_ok=True)

    def read(rgb: Tensor) -> Tensor:
        return torch.stack([one(image) for image in rgb])

    def one(image: Tensor) -> Tensor:
        file = folder / f"{_digest(image)}.npy"
        if not file.exists():
            with whole_file(file) as partial, partial.open("wb") as out:
                np.save(out, encode(image[None])[0].detach().half().cpu().numpy())
        return torch.from_numpy(np.load(file)).to(image.device).float()

    network.encode = read  # type: ignore[method-assign]


def _digest(image: Tensor) -> str:
    return hashlib.blake2b(np.ascontiguousarray(image.cpu().numpy()).data, digest_size=16).hexdigest()
