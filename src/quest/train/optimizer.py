"""The optimiser: Muon for the matrices inside the network, AdamW for all else.

Reference: Jordan et al., *Muon: an optimizer for hidden layers in neural networks*, 2024, in steps as large as AdamW's
(Liu et al., *Muon is Scalable for LLM Training*, 2025), so that one learning rate and weight decay serve both parts.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import nn

from quest.train.settings import TrainingConfig

_INNER = 64
"""A matrix whose smaller side is below this maps to or from a handful of numbers, and is no inner one."""


def make_optimizer(
    network: nn.Module, trained: Sequence[nn.Parameter], config: TrainingConfig
) -> torch.optim.Optimizer:
    """The optimiser of a run.

    Args:
        network: what the parameters are of.
        trained: its parameters that are trained.
        config: which optimiser, learning rate and weight decay.
    """
    lr, decay = config.learning_rate, config.weight_decay
    inner = _inner(network, trained) if config.optimizer == "muon" else []
    chosen = {id(p) for p in inner}
    adamw = torch.optim.AdamW([p for p in trained if id(p) not in chosen], lr=lr, weight_decay=decay)
    if not inner:
        return adamw
    return _Both(adamw, torch.optim.Muon(inner, lr=lr, weight_decay=decay, adjust_lr_fn="match_rms_adamw"))


def _inner(network: nn.Module, trained: Sequence[nn.Parameter]) -> list[nn.Parameter]:
    """Weights of linear layers that are trained, but for small ones; tables of codes are no linear maps."""
    inner = {id(m.weight) for m in network.modules() if isinstance(m, nn.Linear) and min(m.weight.shape) >= _INNER}
    return [p for p in trained if id(p) in inner]


class _Both(torch.optim.Optimizer):
    """Two optimisers of different parameters that look like one: one state, one list of groups."""

    def __init__(self, first: torch.optim.Optimizer, second: torch.optim.Optimizer) -> None:
        super().__init__([*first.param_groups, *second.param_groups], {})
        self._parts = (first, second)

    def step(self, closure: None = None) -> None:  # type: ignore[override]
        """One step of both."""
        for part, group in zip(self._parts, self.param_groups, strict=True):
            # Anew in every step: loading a state replaces both.
            part.param_groups, part.state = [group], self.state
            part.step()
