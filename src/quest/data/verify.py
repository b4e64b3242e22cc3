"""Verify stored takes: hashes, and every truth against the others (:mod:`quest.data.consistency`).

Only what is stored is read; nothing is rendered again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

from quest.data.consistency import Check, check_truth, check_view
from quest.data.store import TakeStore
from quest.data.take_format import TakeHash, TakeHeader, take_arrays
from quest.errors import QuestError
from quest.types import Take, View


@dataclass(frozen=True)
class TakeReport:
    """What verifying one take found."""

    name: str
    """The take."""
    frames: int
    """Its frames; 0 if it cannot be read."""
    views: int
    """Its views."""
    checks: tuple[Check, ...]
    """Every check, those of views once per view."""
    problem: str = ""
    """Why it cannot be read; empty if it can."""

    @property
    def passed(self) -> bool:
        """Whether it can be read and keeps every limit."""
        return not self.problem and all(check.passed for check in self.checks)

    def worst(self, name: str) -> Check | None:
        """The worst of the checks of a name over all views; None if it was not made."""
        return max((c for c in self.checks if c.name == name), key=lambda c: (not c.passed, c.worst), default=None)

    def message(self) -> str:
        """What is wrong, in one line; empty if nothing is."""
        if self.problem:
            return self.problem if self.name in self.problem else f"take {self.name!r}: {self.problem}"
        found = "; ".join(str(check) for check in self.checks if not check.passed)
        return f"take {self.name!r}: {found}" if found else ""


@dataclass(frozen=True)
class StoreReport:
    """What verifying the takes of a store found."""

    takes: tuple[TakeReport, ...]
    """One report per take, in order of their names."""

    @property
    def passed(self) -> bool:
        """Whether every take passed."""
        return all(take.passed for take in self.takes)

    @property
    def failed(self) -> tuple[TakeReport, ...]:
        """The takes that did not pass."""
        return tuple(take for take in self.takes if not take.passed)

    def worst(self, name: str) -> tuple[str, Check] | None:
        """The worst result of a check over all takes, and the take's name; None if it was never made."""
        found = [(take.name, check) for take in self.takes for check in [take.worst(name)] if check is not None]
        return max(found, key=lambda pair: (not pair[1].passed, pair[1].worst), default=None)

    def check_names(self) -> list[str]:
        """Names of all checks that were made, in the order in which they are made."""
        return list(dict.fromkeys(check.name for take in self.takes for check in take.checks))


def verify_take(store: TakeStore, name: str) -> TakeReport:
    """Read a take, view by view, and check it."""
    try:
        header = store.header(name)
        truth = store.read(name, views=[])
        checks = tuple(_check_take(store, name, header, truth))
    except QuestError as error:
        return TakeReport(name, 0, 0, (), " ".join(str(error).split()))
    return TakeReport(name, header.frames, len(header.cameras), checks)


def verify_store(
    store: TakeStore, names: Sequence[str] | None = None, *, report: Callable[[TakeReport], None] = lambda _: None
) -> StoreReport:
    """Check takes of a store.

    Args:
        store: the store.
        names: the takes; by default all, those that cannot be read included.
        report: told about each take as soon as it is done.
    """
    done = []
    for name in names if names is not None else sorted({*store.names(), *store.problems()}):
        done.append(verify_take(store, name))
        report(done[-1])
    return StoreReport(tuple(done))


def _check_take(store: TakeStore, name: str, header: TakeHeader, truth: Take) -> Iterator[Check]:
    digest = TakeHash(header.info, header.cameras)
    for path, array in take_arrays(truth):
        digest.add(path, array)
    checks = list(check_truth(truth))
    computable = all(check.passed for check in checks if check.name in ("indices", "finite"))
    for v in range(len(header.cameras)):
        view = store.read_view(name, v)
        for path, array in _view_arrays(truth, view):
            digest.add(f"view_{v}/{path}", array)
        if computable:
            checks += check_view(truth, view, v)
    found = digest.hexdigest()
    same = found == header.data_hash
    yield Check(
        "hash", same, float(not same), 0.0, "", "" if same else f"{found[:12]}, recorded {header.data_hash[:12]}"
    )
    yield from checks


def _view_arrays(truth: Take, view: View) -> Iterator:
    for path, array in take_arrays(replace(truth, views=(view,))):
        if path.startswith("view_0/"):
            yield path.removeprefix("view_0/"), array
