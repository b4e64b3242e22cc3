"""The optimiser, and the running mean of what it trains, which is what is validated and kept.

Muon serves the matrices inside the network, AdamW all else, in steps as large as AdamW's, so that one learning rate and
weight decay serve both parts. Neighbouring weights of one training err in different ways, and their mean errs less than
each of them.

References: Jordan et al., *Muon: an optimizer for hidden layers in neural networks*, 2024; Liu et al., *Muon is
Scalable for LLM Training*, 2025; Polyak and Juditsky, *Acceleration of Stochastic Approximation by Averaging*, 1992,
exponentially weighted as in Tarvainen and Valpola, *Mean teachers are better role models*, 2017.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from quest.model.precision import fast_bfloat16
from quest.train.settings import TrainingConfig

_INNER = 64
"""A matrix whose smaller side is below this maps to or from a handful of numbers, and is no inner one."""
SHARE = "share"
"""Key of a group's learning rate as a share of the whole one."""


def make_optimizer(
    network: nn.Module, trained: Sequence[nn.Parameter], config: TrainingConfig, *, refined: Sequence[nn.Parameter] = ()
) -> torch.optim.Optimizer:
    """The optimiser of some parameters of a network, of which the refined ones learn at the smaller rate, by AdamW."""
    lr, decay = config.learning_rate, config.weight_decay
    slow = {id(p) for p in refined}
    inner = [p for p in _inner(network, trained) if id(p) not in slow] if config.optimizer == "muon" else []
    chosen = slow | {id(p) for p in inner}
    groups: list[dict[str, Any]] = [{"params": [p for p in trained if id(p) not in chosen], SHARE: 1.0}]
    if refined:
        groups.append({"params": list(refined), SHARE: config.refined_rate})
    adamw = torch.optim.AdamW(groups, lr=lr, weight_decay=decay, fused=True)
    if not inner:
        return adamw
    muon = Muon(inner, lr=lr, weight_decay=decay)
    muon.param_groups[0][SHARE] = 1.0
    return _Both(adamw, muon)


def _inner(network: nn.Module, trained: Sequence[nn.Parameter]) -> list[nn.Parameter]:
    """Weights of linear layers that are trained, but for small ones; tables of codes are no linear maps."""
    inner = {id(m.weight) for m in network.modules() if isinstance(m, nn.Linear) and min(m.weight.shape) >= _INNER}
    return [p for p in trained if id(p) in inner]


class Muon(torch.optim.Muon):
    """PyTorch's ``match_rms_adamw``, with products in float32 where bfloat16 is slow.

    Most processors only emulate bfloat16: there a step of PyTorch's takes twenty times as long.
    """

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        """One step of all parameters that have a gradient."""
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is not None:
                    self._step(parameter, parameter.grad, group)

    def _step(self, parameter: nn.Parameter, gradient: Tensor, group: dict[str, Any]) -> None:
        state, momentum = self.state[parameter], group["momentum"]
        mean = state.setdefault("momentum_buffer", torch.zeros_like(gradient))
        mean.lerp_(gradient, 1 - momentum)
        update = orthogonal(gradient.lerp(mean, momentum), group)
        parameter.mul_(1 - group["lr"] * group["weight_decay"])
        parameter.add_(update, alpha=-group["lr"] * 0.2 * max(parameter.shape) ** 0.5)


def orthogonal(matrix: Float[Tensor, "M N"], group: dict[str, Any]) -> Float[Tensor, "M N"]:
    """What is near the closest orthogonal matrix, by Newton-Schulz iteration as :class:`torch.optim.Muon` is told."""
    a, b, c = group["ns_coefficients"]
    x = matrix.bfloat16() if fast_bfloat16(matrix.device) else matrix
    x = x.T if x.shape[0] > x.shape[1] else x
    x = x / x.norm().clamp(min=group["eps"])
    for _ in range(group["ns_steps"]):
        gram = x @ x.T
        x = torch.addmm(x, torch.addmm(gram, gram, gram, beta=b, alpha=c), x, beta=a)
    return x.T if matrix.shape[0] > matrix.shape[1] else x


class _Both(torch.optim.Optimizer):
    """Two optimisers of different parameters that look like one: one state, one list of groups."""

    def __init__(self, first: torch.optim.Optimizer, second: torch.optim.Optimizer) -> None:
        super().__init__([*first.param_groups, *second.param_groups], {})
        self._parts = [part for part in (first, second) for _ in part.param_groups]

    def step(self, closure: None = None) -> None:  # type: ignore[override]
        """One step of both."""
        for part, group in zip(self._parts, self.param_groups, strict=True):
            # Anew in every step: loading a state replaces both.
            part.param_groups, part.state = [group], self.state
            part.step()


_KEY = "mean"


class RunningMean:
    """The exponentially weighted mean of parameters over the steps of their optimiser.

    It lies in the optimiser's state, beside its moments, so that whoever saves or loads those does so with it.
    """

    def __init__(self, parameters: Sequence[nn.Parameter], optimizer: torch.optim.Optimizer, decay: float) -> None:
        """With a decay of 0 the mean is the parameters themselves."""
        self._parameters = parameters
        self._optimizer = optimizer
        self._decay = decay

    @torch.no_grad()
    def update(self, step: int) -> None:
        """Take in the parameters after a step of the optimiser, counted from 1."""
        # Young means forget faster: the first steps are the worst.
        weight = 1 - min(self._decay, step / (step + 9))
        for parameter in self._parameters:
            state = self._optimizer.state[parameter]
            if _KEY in state:
                state[_KEY].lerp_(parameter, weight)
            else:
                state[_KEY] = parameter.detach().clone()

    @contextmanager
    def applied(self) -> Iterator[None]:
        """The parameters are their mean inside; those without one, because nothing was learned yet, stay."""
        kept = [parameter.detach().clone() for parameter in self._parameters]
        with torch.no_grad():
            for parameter in self._parameters:
                parameter.copy_(self._optimizer.state.get(parameter, {}).get(_KEY, parameter))
        try:
            yield
        finally:
            with torch.no_grad():
                for parameter, value in zip(self._parameters, kept, strict=True):
                    parameter.copy_(value)
