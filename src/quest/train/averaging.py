"""The running mean of what is trained, which is what is validated and kept.

Neighbouring weights of one training err in different ways, and their mean errs less than each of them (Polyak and
Juditsky, *Acceleration of Stochastic Approximation by Averaging*, 1992; exponentially weighted as in Tarvainen and
Valpola, *Mean teachers are better role models*, 2017).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import nn

_KEY = "mean"


class RunningMean:
    """The exponentially weighted mean of parameters over the steps of their optimiser.

    It lies in the optimiser's state, beside its moments, so that whoever saves or loads those does so with it.
    """

    def __init__(self, parameters: Sequence[nn.Parameter], optimizer: torch.optim.Optimizer, decay: float) -> None:
        """Keep the mean of some parameters of an optimiser; with a decay of 0 it is the parameters themselves."""
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
