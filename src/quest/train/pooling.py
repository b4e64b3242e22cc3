"""Means over a batch that is divided among processes and micro-batches.

Most losses are means over what counts: so much error, divided by how many answers it is of. The mean of the parts'
means is another number, and its gradient another gradient. So a loss asks :func:`pooled` how much counts in the
*whole* batch and divides its own part by that; the parts then add up to what one process would have computed.

What counts may depend on the predictions (a point that cannot be lifted has no distance), so that it is known only
after the forward pass: among processes it is summed as the losses ask for it; micro-batches take a pass without
gradients first, in which it is counted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch
from jaxtyping import Float
from torch import Tensor

Pool = Callable[[Tensor], Tensor]
"""From how much counts in the part at hand to how much counts in the whole batch."""

_pool: ContextVar[Pool | None] = ContextVar("_pool", default=None)


def pooled(count: Float[Tensor, ""]) -> Float[Tensor, ""]:
    """How much counts in the whole batch, by the part at hand, which is the whole outside of :func:`pooling`."""
    pool = _pool.get()
    return count if pool is None else pool(count.detach())


@contextmanager
def pooling(pool: Pool | None) -> Iterator[None]:
    """Losses that are computed inside are parts of a larger batch."""
    token = _pool.set(pool)
    try:
        yield
    finally:
        _pool.reset(token)


class Tally:
    """Counts of micro-batches, added up in the order in which the losses ask, which is the same for each of them."""

    def __init__(self) -> None:
        self._totals: list[Tensor] = []
        self._next = 0

    def restart(self) -> None:
        """The next question is a micro-batch's first."""
        self._next = 0

    def add(self, count: Tensor) -> Tensor:
        """A pool for the pass that counts."""
        if self._next == len(self._totals):
            self._totals.append(torch.zeros_like(count))
        self._totals[self._next] = self._totals[self._next] + count
        self._next += 1
        return count

    def sum_over(self, reduce: Pool) -> None:
        """Add up the processes' counts, all at once."""
        if self._totals:
            self._totals = list(reduce(torch.stack([t.float() for t in self._totals])).unbind())

    def read(self, count: Tensor) -> Tensor:
        """A pool for the pass that learns."""
        total = self._totals[self._next].to(count.dtype)
        self._next += 1
        return total
