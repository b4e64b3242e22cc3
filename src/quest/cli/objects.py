"""``quest objects``: which objects there are, how they look with their entities, and more of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from quest.cli.console import Console
from quest.cli.progress import counting
from quest.cli.takes import check_picture, write_picture
from quest.errors import ConfigError, ObjectError
from quest.wording import counted

if TYPE_CHECKING:
    from quest.sim.objects import SimObject
    from quest.sim.plan import ObjectShelf


_LINE = "{:<22} {:<18} {:>6}  {:<20}  {}"


def _consoles() -> tuple[Console, Console]:
    """Standard output and standard error, for whole lines."""
    return Console(), Console(stderr=True)


@dataclass(frozen=True)
class ObjectsList:
    """List objects with their joints, entities and sizes, and the faults of those that cannot be used."""

    objects_root: Path | None = None
    """Folder of object folders; QUEST_OBJECTS by default."""
    procedural: bool = False
    """List the procedural categories instead, by one object of each."""

    def run(self) -> int:
        """Print a line for each object as it is read; returns 1 if an object cannot be used."""
        from quest.viz.object_sheet import entity_words, size_words

        out, errors = _consoles()
        out.print(_LINE.format("object", "category", "joints", "size, m", "entities"), style="bold")
        problems = 0
        for thing in self._things():
            if isinstance(thing, ObjectError):
                problems += 1
                errors.print(str(thing), style="red")
                continue
            joints = len(thing.articulation.joints)
            out.print(_LINE.format(thing.object_id, thing.category, joints, size_words(thing), entity_words(thing)))
            for warning in thing.warnings:
                out.print(f"{thing.object_id}: {warning}", style="yellow")
        out.print("size: width x depth x height, closed")
        return 1 if problems else 0

    def _things(self) -> Iterator[SimObject | ObjectError]:
        from quest.sim.objects import find_objects, load_object
        from quest.sim.procedural import CATEGORIES, make_object

        if self.procedural:
            yield from (make_object(category, 0) for category in CATEGORIES)
            return
        for folder in find_objects(self.objects_root):
            try:
                yield load_object(folder)
            except ObjectError as error:
                yield error


@dataclass(frozen=True)
class ObjectsShow:
    """Draw objects, closed and open, from a few sides, with their entities marked and named."""

    objects: tyro.conf.Positional[tuple[str, ...]]
    """Each an id (44817), ids (partnet:44817,23724), a folder or URDF of your own, a procedural object
    (procedural:chest-12), a category (procedural:chest), or a mix (procedural:usual, procedural:broad)."""
    out: Path = Path("objects.png")
    """Picture to write (PNG, JPEG, WebP)."""
    objects_root: Path | None = None
    """Folder of object folders; QUEST_OBJECTS by default."""
    count: int = 12
    """How many objects of a category or mix."""
    first_seed: int = 0
    """Seed of the first of them; the others count up."""
    sides: int = 2
    """From how many sides each is seen."""
    columns: int = 0
    """Objects beside each other; 0 chooses."""
    size: int = 240
    """Edge length of every portrait, pixels."""

    def run(self) -> int:
        """Write the picture and say where it is."""
        from quest.sim.plan import ObjectShelf
        from quest.sim.portrait import portray
        from quest.sim.renderer import Renderer
        from quest.viz.object_sheet import Card, object_sheet

        if not self.objects:
            raise ConfigError("objects show: no object is named; name an id, a folder, a URDF or procedural:broad")
        if self.count < 1 or self.columns < 0:
            raise ConfigError(
                f"objects show: expected --count >= 1 and --columns >= 0, got {self.count} and {self.columns}"
            )
        check_picture("objects show", self.out)
        shelf = ObjectShelf(self.objects_root)
        things = [thing for name in self.objects for thing in self._named(name, shelf)]
        renderer = Renderer()
        cards = [Card(t, portray(t, renderer, sides=self.sides, size_px=self.size)) for t in things]
        columns = self.columns or max(1, round((len(cards) / (2 * self.sides) * 1.6) ** 0.5))
        write_picture(object_sheet(cards, columns=columns), self.out, counted(len(cards), "object"))
        return 0

    def _named(self, name: str, shelf: ObjectShelf) -> list[SimObject]:
        """The objects that a name stands for."""
        from quest.sim.objects import load_object
        from quest.sim.plan import parse_object
        from quest.sim.procedural import CATEGORIES, MIXES, category_for_seed

        path = Path(name)
        if path.exists() or path.suffix in (".urdf", ".xacro") or len(path.parts) > 1:
            return [load_object(path)]
        source, _, rest = name.partition(":")
        seeds = range(self.first_seed, self.first_seed + self.count)
        if source == "procedural" and rest in CATEGORIES:
            return [shelf.load(source, f"{rest}-{seed}") for seed in seeds]
        for mix in MIXES:
            if source == "procedural" and rest == mix:
                return [shelf.load(source, f"{category_for_seed(seed, mix=mix)}-{seed}") for seed in seeds]
        return [shelf.load(*found) for found in parse_object(name)]


@dataclass(frozen=True)
class ObjectsImport:
    """Make folders of objects of furniture libraries of Sweet Home 3D: what opens, and things that do not.

    What is there already is kept, so that an import that was stopped goes on.
    """

    libraries: tyro.conf.Positional[tuple[Path, ...]]
    """Libraries, such as those of Debian's package sweethome3d-furniture (.sh3f)."""
    out: Path
    """Folder that gets an object folder per model that opens, things/ with the others, and CREDITS.md."""

    def run(self) -> int:
        """Print what came out of each library, and what was left out; returns 1 if nothing came out of one."""
        from quest.sim.sweethome import import_library

        if not self.libraries:
            raise ConfigError("objects import: no library is named; name an .sh3f file")
        out, errors = _consoles()
        empty = 0
        for path in self.libraries:
            with counting(errors, f"importing {path.name}", None, "models") as tell:
                results = list(import_library(path, self.out, tell))
            for warning in (warning for result in results for warning in result.warnings):
                errors.print(warning, style="yellow")
            there = [result for result in results if result.folder is not None]
            opens, kept = sum(r.opens for r in there), sum(r.kept for r in there)
            out.print(
                f"{path.name}: {counted(opens, 'object')} that {'opens' if opens == 1 else 'open'}, "
                f"{counted(len(there) - opens, 'thing')}, {len(results) - len(there)} left out; {kept} were there"
            )
            empty += not there
        out.print(f"{self.out}: see CREDITS.md for authors and licences")
        return 1 if empty else 0
