"""From labelled pictures and take stores to cuts: which of them teach, which choose, and their views."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from quest.data.boxed_pictures import may_choose, read_boxed_pictures
from quest.data.store import TakeStore
from quest.errors import ConfigError
from quest.model.finder import FinderNetwork
from quest.train.dataset import UNSTATED, has_role, roles_of
from quest.train.finding.sampler import FinderSampler
from quest.train.finding.settings import FinderSamplerConfig
from quest.train.finding.views import PictureCache, Source, ViewCache, of_pictures, of_takes

_UNKNOWN = ("", "unknown")


@dataclass(frozen=True)
class FinderData:
    """Cuts to learn from and views to choose by."""

    training: FinderSampler
    """Of what teaches."""
    validation: FinderSampler
    """Of what chooses."""
    about: str
    """How much teaches, in words."""
    sources: frozenset[str]
    """Of the takes that teach, and whether there are pictures without a licence, as for ``licence_after``."""


def open_finder_data(
    network: FinderNetwork,
    *,
    pictures: Sequence[Path],
    free: bool,
    stores: Sequence[str | Path],
    validation_stores: Sequence[str | Path],
    cache: Path,
    views: int,
    frames: int,
    config: FinderSamplerConfig,
    report: Callable[[int, int], None],
) -> FinderData:
    """Divide pictures and takes, and make their views or, where the transformer learns, copy them.

    Args:
        network: whose transformer looks.
        pictures: labelled sets (see :func:`quest.data.boxed_pictures.read_boxed_pictures`).
        free: whether only pictures that name a licence are used.
        stores: take stores; with ``validation_stores``, objects that are in no part of the split teach too.
        validation_stores: take stores to choose by.
        cache: folder of the views.
        views: views of each picture that teaches; frames of takes have one, as takes hold many that are alike.
        frames: frames of each view of a take.
        config: how cuts are drawn.
        report: told pictures and frames done, and all of them.

    Raises:
        InputError: labels cannot be read.
        ConfigError: nothing is left to teach or to choose.
    """
    labelled: dict[str, list[Source]] = {"train": [], "validation": []}
    unstated = False
    for boxed in map(read_boxed_pictures, pictures):  # each by itself: what one has labelled says nothing of another
        stated = [picture.licence not in _UNKNOWN for picture in boxed]
        chooses = [may_choose(picture.path.name) for picture in boxed]
        for part, own in (("train", False), ("validation", True)):
            wanted = [c == own and (s or not free) for c, s in zip(chooses, stated, strict=True)]
            labelled[part] += of_pictures(boxed, only=wanted)
            unstated |= part == "train" and any(w and not s for w, s in zip(wanted, stated, strict=True))
    simulated: dict[str, list[Source]] = {"train": [], "validation": []}
    takes, taught_by = 0, set[str]()
    for role, folder in roles_of(stores, validation_stores):
        store = TakeStore(folder)
        chosen = {n: i for n, i in store.infos().items() if has_role(i, role, apart=bool(validation_stores))}
        if role == "train":
            takes, taught_by = takes + len(chosen), taught_by | {info.source for info in chosen.values()}
        simulated[role] += of_takes(store, list(chosen), frames=frames)
    for part, verb in (("train", "teach"), ("validation", "choose")):
        if not labelled[part] and not simulated[part]:
            raise ConfigError(f"training: no pictures and no takes are left to {verb}; give more of them")
    known, whole = ViewCache(cache, network), PictureCache(cache)
    total, done = sum(len(s) for sources in (labelled, simulated) for s in sources.values()), 0
    paths: dict[tuple[str, str], list[Path]] = {}
    for kind, sources in (("pictures", labelled), ("takes", simulated)):
        for part, own in sources.items():
            count = views if (kind, part) == ("pictures", "train") else 1
            paths[kind, part] = []
            for source in own:
                paths[kind, part] += (
                    [whole.build(source)] if config.learned_blocks else known.build(source, views=count)
                )
                done += 1
                report(done, total)
    return FinderData(
        FinderSampler(paths["pictures", "train"], paths["takes", "train"], config),
        FinderSampler(paths["pictures", "validation"], paths["takes", "validation"], config),
        f"{len(labelled['train'])} pictures and {takes} takes",
        frozenset(taught_by | ({UNSTATED} if unstated else set())),
    )
