"""Which takes a run makes, and where their objects come from."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from quest.data.split import Part, object_split
from quest.errors import ObjectError
from quest.sim.description import CREDIT_NAME
from quest.sim.generate import take_name
from quest.sim.objects import SimObject, find_objects, load_object, object_id_of
from quest.sim.procedural import CATEGORIES, category_for_seed, make_object
from quest.sim.settings import TakeSettings
from quest.sim.suites import Suite


@dataclass(frozen=True)
class TakeSpec:
    """One take to make."""

    source: str
    """``partnet``, ``procedural`` or ``own``."""
    object_id: str
    """Folder name, ``category-seed``, or the path of a user's own folder or URDF."""
    level: int
    seed: int
    settings: TakeSettings = TakeSettings()
    suite: Suite | None = None
    """Which suite it belongs to; None for an ordinary take."""

    @property
    def name(self) -> str:
        """Name of the take in its store."""
        object_id = object_id_of(Path(self.object_id)) if self.source == "own" else self.object_id
        return take_name(object_id, self.level, self.seed, self.suite)


def plan_takes(
    objects: Iterable[tuple[str, str]],
    *,
    levels: Sequence[int],
    takes_per_object: int,
    first_seed: int = 0,
    settings: TakeSettings = TakeSettings(),
    suites: Sequence[Suite] = (),
) -> list[TakeSpec]:
    """Takes of every object at every level, all objects once before any comes again.

    Objects are given by source and id. There are ``takes_per_object`` of each at each level, in each suite; their seeds
    count up. If there are suites, takes are theirs, with their settings, instead of ordinary ones.
    """
    chosen = list(objects)
    kinds = [(suite.settings, suite) for suite in suites] or [(settings, None)]
    return [
        TakeSpec(source, object_id, level, first_seed + n, how, suite)
        for n in range(takes_per_object)
        for level in levels
        for source, object_id in chosen
        for how, suite in kinds
    ]


def parse_object(text: str) -> list[tuple[str, str]]:
    """Sources and ids of ``partnet:44817,23724``, ``procedural:chest-12``, ids alone (PartNet-Mobility), or a path.

    A path, with a slash in it or ending in ``.urdf``, is a user's own object; so is the name of a folder here that
    holds a URDF.

    Raises:
        ObjectError: the source is unknown, no id is given, or there is no object at the path.
    """
    here = ":" not in text and Path(text).is_dir() and any(Path(text).glob("*.urdf"))
    if here or "/" in text or "\\" in text or text.endswith(".urdf"):
        object_id_of(Path(text))  # told at once
        return [("own", text)]
    source, colon, ids = text.partition(":")
    if not colon:
        source, ids = "partnet", text
    names = [name.strip() for name in ids.split(",") if name.strip()]
    if source not in ("partnet", "procedural") or not names:
        raise ObjectError(
            f"objects {text!r}: expected partnet:ID,ID (partnet:44817,23724), procedural:CATEGORY-SEED, or a path"
        )
    return [(source, name) for name in names]


def imported_objects(root: Path, part: Part) -> list[tuple[str, str]]:
    """Sources and paths of the objects of ``quest objects import`` that are in a part of the split.

    Raises:
        ObjectError: one of them is not below ``root``.
    """
    named = object_split().sweethome3d[part]
    missing = [name for name in named if not (root / name / CREDIT_NAME).is_file()]
    if missing:
        raise ObjectError(
            f"{root}: expected the {len(named)} imported objects of the split's part {part!r}, found no "
            f"{', '.join(missing[:3])}{', …' if len(missing) > 3 else ''}; import all libraries of the Debian package "
            f"sweethome3d-furniture there (quest objects import)"
        )
    return [("own", str(root / name)) for name in named]


def procedural_objects(
    count: int, first_seed: int, category: str | None = None, *, mix: str = "usual"
) -> list[tuple[str, str]]:
    """``count`` procedural objects, one per object seed, of a category or in a mix of categories."""
    seeds = range(first_seed, first_seed + count)
    return [("procedural", f"{category or category_for_seed(seed, mix=mix)}-{seed}") for seed in seeds]


class ObjectShelf:
    """Loads objects by source and id, and keeps them.

    ``root`` is the folder of PartNet-Mobility folders; by default the environment's ``QUEST_OBJECTS``.
    """

    def __init__(self, root: Path | None = None) -> None:
        self._root = root
        self._folders: dict[str, Path] | None = None
        self._loaded: dict[tuple[str, str], SimObject | ObjectError] = {}

    def load(self, source: str, object_id: str) -> SimObject:
        """An object; one that failed before fails again without being read again.

        Raises:
            ObjectError: there is no such object, or it cannot be used.
        """
        key = (source, object_id)
        if key not in self._loaded:
            try:
                self._loaded[key] = self._load(source, object_id)
            except ObjectError as error:
                self._loaded[key] = error
        found = self._loaded[key]
        if isinstance(found, ObjectError):
            raise found
        return found

    def _load(self, source: str, object_id: str) -> SimObject:
        if source == "own":
            return load_object(Path(object_id))
        if source == "procedural":
            category, _, seed = object_id.rpartition("-")
            if category not in CATEGORIES or not seed.isdecimal():
                raise ObjectError(
                    f"procedural object {object_id!r}: expected CATEGORY-SEED with one of {', '.join(CATEGORIES)}"
                )
            return make_object(category, int(seed))
        if self._folders is None:
            self._folders = {folder.name: folder for folder in find_objects(self._root)}
        if object_id not in self._folders:
            raise ObjectError(
                f"object {object_id!r}: expected one of the {len(self._folders)} folders of PartNet-Mobility objects, "
                f"found none of that name; check the id and the folder"
            )
        return load_object(self._folders[object_id])
