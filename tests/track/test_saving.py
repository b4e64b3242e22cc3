"""Trees of state as bytes: what is saved comes back with its types, on any device, and nothing else is taken for it."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from quest.errors import InputError
from quest.filter.joints import JointKind
from quest.track.saving import load, save
from quest.types import Query


@dataclass
class Twig:
    kind: JointKind
    q: float
    below: np.ndarray | None = None
    _learned: Tensor | None = field(default=None, init=False)


@dataclass(frozen=True)
class Tree:
    twigs: dict[int, Twig]
    recent: deque[tuple[float, np.ndarray]]
    asked: list[Query]
    flags: tuple[str, ...] = ()
    first: Twig | None = None


@dataclass(frozen=True)
class Sprout:
    flags: tuple[str, ...]
    height_m: float = 0.1
    leaves: list[int] = field(default_factory=list)


def make_tree() -> Tree:
    twig = Twig(JointKind.REVOLUTE, float("nan"), np.arange(6, dtype=np.int64).reshape(2, 3).T)
    twig._learned = torch.arange(4, dtype=torch.bfloat16)[::2]
    asked = [Query.point(2, 1.5, 2.5, name="lid"), Query.semantic("handle")]
    recent = deque([(0.1, np.zeros((0, 3))), (1 / 3, np.array(7.0))], maxlen=2)
    return Tree({3: twig, 1: Twig(JointKind.STATIC, -0.0)}, recent, asked, ("late", "dark"))


def test_a_tree_comes_back():
    tree = make_tree()
    again = load(save(tree), Tree)
    assert list(again.twigs) == [3, 1]
    twig, other = again.twigs.values()
    assert twig.kind is JointKind.REVOLUTE
    assert np.isnan(twig.q)
    assert twig.below is not None
    np.testing.assert_array_equal(twig.below, tree.twigs[3].below)
    assert twig.below.dtype == np.int64
    assert twig._learned is not None
    assert twig._learned.dtype == torch.bfloat16
    assert twig._learned.tolist() == [0.0, 2.0]
    assert other == tree.twigs[1]
    assert again.recent.maxlen == 2
    assert [at for at, _ in again.recent] == [0.1, 1 / 3]
    assert [array.shape for _, array in again.recent] == [(0, 3), ()]
    assert (again.asked, again.flags, again.first) == (tree.asked, tree.flags, None)
    assert save(again) == save(tree)


def test_what_an_older_version_did_not_save_takes_its_default():
    @dataclass(frozen=True)
    class Seed:
        flags: tuple[str, ...]

    assert load(save({"": Seed(("late",))}), dict[str, Sprout]) == {"": Sprout(("late",))}
    with pytest.raises(InputError, match="saved stream"):
        load(save({"": Seed(("late",))}), dict[str, Twig])


def test_what_was_saved_shares_no_memory_with_what_goes_on():
    tree = make_tree()
    data = save(tree)
    assert tree.twigs[3].below is not None
    tree.twigs[3].below[:] = 0
    assert save(tree) != data
    again = load(data, Tree)
    assert again.twigs[3].below is not None
    again.twigs[3].below += 1
    assert save(load(data, Tree)) == data


def test_numbers_of_numpy_are_saved():
    """Cameras and queries are often made of them."""
    numbers: Any = {3: [np.float32(1.5), np.int64(3), np.bool_(True)]}
    assert load(save(numbers), dict[int, list[float]]) == {3: [1.5, 3, True]}


def test_double_precision_stays_on_the_cpu():
    tensors = {0: torch.zeros(2, dtype=torch.float64), 1: torch.zeros(2)}
    again = load(save(tensors), dict[int, Tensor], device="meta")
    assert [again[i].device.type for i in (0, 1)] == ["cpu", "meta"]


def test_what_is_no_such_tree_is_refused():
    data = save(make_tree())
    for corrupt in (b"", b"abc", data[:-7], data[: len(data) // 2]):
        with pytest.raises(InputError, match="saved stream"):
            load(corrupt, Tree)
    with pytest.raises(InputError, match="saved stream"):
        load(data, Twig)
    with pytest.raises(InputError, match="expected format 'quest-stream-"):
        load(data.replace(b"quest-stream-", b"quest-scream-"), Tree)


def test_any_turned_bit_is_refused():
    data = save(make_tree())
    length = int.from_bytes(data[:8], "little")
    blanks = range(8 + len(data[8 : 8 + length].rstrip()), 8 + length)  # what fills the header up says nothing
    for at in range(len(data)):
        if at not in blanks:
            with pytest.raises(InputError):
                load(data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :], Tree)
