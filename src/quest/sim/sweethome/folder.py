"""Folders of objects, and of things that do not open, from a furniture library."""

from __future__ import annotations

import hashlib
import io
import json
import re
import shutil
import uuid
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Bool, Float
from PIL import Image
from scipy.spatial.transform import Rotation

from quest.errors import ObjectError
from quest.sim.description import CREDIT_NAME, DESCRIPTION_NAME
from quest.sim.sweethome.joints import Link, Note, find_links, grips, notes
from quest.sim.sweethome.library import Library, Model
from quest.sim.sweethome.wavefront import Wavefront, read_materials, read_wavefront
from quest.untrusted import read_json, reading
from quest.whole_file import whole_file

THINGS = "things"
"""Folder of what does not open."""
CREDITS = "CREDITS.md"

_FORMAT = 1
"""Counts up when the same library gives other folders."""
_PARTIAL = ".partial"
_MOST_PIXELS = 8192**2
_GRIP_GAP_M = 0.01
_MOST_PIECES = 1000
"""Of handles of a link, beyond which they are not told apart."""
_MATERIALS = "materials.mtl"
_TRAY_RGBA = "0.72 0.62 0.48 1"
_TRAY_WALL_M = 0.012
_WORD_OF_CATEGORY = {"window": "Window", "door": "Door"}


@dataclass(frozen=True)
class Imported:
    """What became of one model."""

    model: str
    """Path in its library."""
    folder: Path | None = None
    """None if it was left out."""
    opens: bool = False
    """Whether it has joints."""
    kept: bool = False
    """Whether its folder was there already."""
    warnings: tuple[str, ...] = ()


def import_library(path: Path, out: Path, tell: Callable[[int, int], None] | None = None) -> Iterator[Imported]:
    """Writes every model of a library that is not there yet as a folder below ``out``, then the credits.

    Args:
        path: the library, an ``.sh3f`` file.
        out: gets a folder for each model that opens, ``things/`` with the others, and ``CREDITS.md``.
        tell: called with the number of models done and of all.

    Raises:
        ObjectError: the library cannot be read. A model that cannot is left out, with a warning.
    """
    shutil.rmtree(out / _PARTIAL, ignore_errors=True)
    with Library(path) as library:
        models = list(library.models())
        credits = {folder: _credit(folder) for folder in _folders(out)}
        names = {credit.get("model"): folder for folder, credit in credits.items()}
        for done, model in enumerate(models):
            if isinstance(model, ObjectError):
                yield Imported("", warnings=(str(model),))
            else:
                try:
                    with reading(f"{path}: {model.path}", ObjectError, "it is left out"):
                        yield _import_model(library, model, out, names)
                except ObjectError as error:
                    yield Imported(model.path, warnings=(str(error),))
            if tell is not None:
                tell(done + 1, len(models))
    shutil.rmtree(out / _PARTIAL, ignore_errors=True)
    write_credits(out)


def write_credits(out: Path) -> None:
    """Writes whose models lie below a folder, as their own notes say."""
    rows = [(folder.relative_to(out).as_posix(), _credit(folder)) for folder in _folders(out)]
    lines = ["# Credits", "", "Models of furniture libraries of Sweet Home 3D, cut into their moving parts by QueST."]
    lines += ["", "| folder | name | by | licence | library |", "|---|---|---|---|---|"]
    keys = ("name", "creator", "licence", "library")
    lines += [f"| {' | '.join(_cell(each) for each in (at, *(c.get(k, '') for k in keys)))} |" for at, c in rows]
    with whole_file(out / CREDITS) as partial:
        partial.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _cell(text: object) -> str:
    """A text of a library for a table of Markdown: on one line, and without its marks."""
    return re.sub(r"([\\|`*_<>\[\]])", r"\\\1", " ".join(re.sub(r"[\x00-\x1f\x7f-\x9f]", " ", str(text)).split()))


def _folders(out: Path) -> list[Path]:
    patterns = (f"*/{CREDIT_NAME}", f"{THINGS}/*/{CREDIT_NAME}")
    return sorted(file.parent for pattern in patterns for file in out.glob(pattern))


def _credit(folder: Path) -> dict[str, str]:
    raw = read_json(folder / CREDIT_NAME, ObjectError, "remove the folder and import it again")
    return raw if isinstance(raw, dict) else {}


def _import_model(library: Library, model: Model, out: Path, names: dict[str | None, Path]) -> Imported:
    note = notes().get(model.path, Note())
    if note.skip:
        return Imported(model.path, warnings=(f"{model.path}: left out, {note.skip}",))
    entry = asdict(model) | {"upright": model.upright.tolist()}
    told = [*library.sums(model.path), json.dumps([entry, asdict(note), _FORMAT])]
    digest = hashlib.sha256("\n".join(told).encode()).hexdigest()[:12]
    known = names.get(model.path)
    if known is not None:
        changed = _credit(known).get("digest") != digest
        said = (f"{known}: the library has changed since; remove the folder to import it again",) if changed else ()
        return Imported(model.path, known, known.parent == out, True, said)
    warnings: list[str] = []
    shape = _standing(read_wavefront(library.read(model.path).decode("utf-8", errors="replace")), model, note)
    links = find_links(shape, note)
    folder = _free_name(model.path, out if links else out / THINGS, names)
    partial = out / _PARTIAL / f"{folder.name}-{uuid.uuid4().hex[:8]}"
    (partial / "meshes").mkdir(parents=True)
    materials = _write_materials(library, model, shape, partial / "meshes", warnings)
    urdf = _urdf(folder.name, shape, links, grips(shape, note), partial / "meshes", materials)
    (partial / f"{folder.name}.urdf").write_text(urdf, encoding="utf-8")
    if links:
        words = {"category": note.category or _category(model), "front": "+x"}
        (partial / DESCRIPTION_NAME).write_text(json.dumps(words, indent=1) + "\n", encoding="utf-8")
    credit = {"name": model.name, "creator": model.creator, "licence": model.licence, "library": library.path.name}
    credit |= {"model": model.path, "digest": digest}
    (partial / CREDIT_NAME).write_text(json.dumps(credit, indent=1) + "\n", encoding="utf-8")
    folder.parent.mkdir(parents=True, exist_ok=True)
    partial.rename(folder)
    names[model.path] = folder
    return Imported(model.path, folder, bool(links), False, tuple(f"{folder.name}: {w}" for w in warnings))


def _free_name(path: str, parent: Path, names: Mapping[str | None, Path]) -> Path:
    """A slug of the file's name, with that of its library where another model has it."""
    taken = {folder.name for folder in names.values()}
    first, stem = (re.sub(r"[^a-z0-9]+", "-", word.lower()).strip("-") or "model" for word in _ends(path))
    tried = [stem, f"{first}-{stem}", *(f"{first}-{stem}-{n}" for n in range(2, 1000))]
    return next(parent / name for name in tried if name not in taken | {THINGS} and not (parent / name).exists())


def _ends(path: str) -> tuple[str, str]:
    stem = re.sub(r"(?<=[a-z])(?=[A-Z])", "-", Path(path).stem)[:80]
    return Path(path).parts[0][:40], stem


def _category(model: Model) -> str:
    known = (word for key, word in _WORD_OF_CATEGORY.items() if key in model.name.lower())
    return next(known, "".join(re.findall("[A-Za-z]+", model.name.title())) or "Unknown")


def _standing(shape: Wavefront, model: Model, note: Note) -> Wavefront:
    """The model in metres, z up, front towards +x, on the floor around the origin."""
    noted = Rotation.from_euler("z", note.turn, degrees=True).as_matrix()
    turn, size = noted @ np.roll(np.eye(3), 1, axis=0) @ model.upright, np.abs(noted) @ model.size_m
    used = np.unique(shape.corners[:, 0])
    vertices = shape.vertices @ turn.T
    low, high = vertices[used].min(axis=0), vertices[used].max(axis=0)
    scale = np.where(high - low > 1e-9, size / np.maximum(high - low, 1e-9), 1.0)
    foot = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
    normals = shape.normals @ turn.T / scale
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    corners = shape.corners.copy()
    corners[:, 0] = np.searchsorted(used, corners[:, 0])
    return replace(shape, vertices=((vertices - foot) * scale)[used], normals=normals, corners=corners)


def _write_materials(
    library: Library, model: Model, shape: Wavefront, folder: Path, warnings: list[str]
) -> tuple[str, ...]:
    """Writes the materials and their pictures; returns the names that the materials got."""
    said: dict[str, dict[str, str]] = {}
    for name in shape.libraries:
        found = library.beside(model.path, name) or library.beside(model.path, f"{Path(model.path).stem}.mtl")
        if found is None:
            warnings.append(f"material file {name[-80:]!r} is missing")
        else:
            said |= read_materials(library.read(found).decode("utf-8", errors="replace"))
    lines, pictures = [], {}
    for i, name in enumerate(shape.materials):
        words = said.get(name, {})
        lines.append(f"newmtl m{i}")
        for key, usual in (("Kd", "0.7 0.7 0.7"), ("Ks", "0.1 0.1 0.1"), ("Ns", "30"), ("d", "1")):
            lines.append(f"{key} {_numbers(words.get(key, usual), usual)}")
        picture = words.get("map_Kd")
        if picture:
            if picture not in pictures:
                pictures[picture] = _write_picture(library, model, picture, folder, len(pictures), warnings)
            if pictures[picture]:
                lines.append(f"map_Kd {pictures[picture]}")
    (folder / _MATERIALS).write_text("\n".join(lines) + "\n", encoding="utf-8")
    return tuple(f"m{i}" for i in range(len(shape.materials)))


def _numbers(text: str, usual: str) -> str:
    try:
        values = [float(word) for word in text.split()][: len(usual.split())]
    except ValueError:
        return usual
    fits = len(values) == len(usual.split()) and all(0 <= v <= 1000 for v in values)
    return " ".join(f"{v:g}" for v in values) if fits else usual


def _write_picture(
    library: Library, model: Model, name: str, folder: Path, number: int, warnings: list[str]
) -> str | None:
    tried = (name, re.split(r"[/\\]", name)[-1], name.split()[-1])  # with a path of the author's machine, or options
    found = next((found for each in tried if (found := library.beside(model.path, each))), None)
    if found is None:
        warnings.append(f"picture {name[-80:]!r} is missing")
        return None
    data = library.read(found)
    try:
        with Image.open(io.BytesIO(data), formats=("JPEG", "PNG")) as picture:
            if picture.width * picture.height > _MOST_PIXELS:
                raise ValueError(f"{picture.width} x {picture.height} pixels")
            picture.verify()
            suffix = {"JPEG": ".jpg", "PNG": ".png"}[str(picture.format)]
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        warnings.append(f"picture {name[:80]!r} is left out ({error})")
        return None
    (folder / f"picture{number}{suffix}").write_bytes(data)
    return f"picture{number}{suffix}"


def _urdf(
    name: str, shape: Wavefront, links: list[Link], labelled: Mapping[str, Bool[np.ndarray, " F"]], folder: Path,
    materials: tuple[str, ...],
) -> str:  # fmt: skip
    """The URDF's text; its meshes are written into ``folder``."""
    robot = ElementTree.Element("robot", name=name)
    rest = ~np.any([np.zeros(len(shape.group), dtype=bool), *(link.faces for link in links)], axis=0)
    for of_link, link, faces in [("base", None, rest), *((link.name, link, link.faces) for link in links)]:
        element = ElementTree.SubElement(robot, "link", name=of_link)
        origin = np.zeros(3) if link is None else link.origin
        placed = shape if link is None else _closed(shape, link)
        for part, of_part in _parts(shape, faces, labelled if link is not None else {}):
            file = f"{of_link}-{part}.obj"
            (folder / file).write_text(placed.text(of_part, _MATERIALS, materials), encoding="utf-8")
            visual = ElementTree.SubElement(element, "visual", name=f"{of_link}-{part}")
            ElementTree.SubElement(visual, "origin", xyz=_words(-origin))
            geometry = ElementTree.SubElement(visual, "geometry")
            ElementTree.SubElement(geometry, "mesh", filename=f"meshes/{file}")
        if link is not None:
            _add_tray(element, link)
            joint = ElementTree.SubElement(robot, "joint", name=f"joint_{of_link}", type=link.kind)
            ElementTree.SubElement(joint, "origin", xyz=_words(origin))
            ElementTree.SubElement(joint, "parent", link="base")
            ElementTree.SubElement(joint, "child", link=of_link)
            ElementTree.SubElement(joint, "axis", xyz=_words(link.axis))
            ElementTree.SubElement(joint, "limit", lower="0", upper=f"{link.opens_by:.5g}", effort="0", velocity="0")
    ElementTree.indent(robot)
    return ElementTree.tostring(robot, encoding="unicode") + "\n"


def _words(values: Float[np.ndarray, "N"]) -> str:
    return " ".join(f"{x + 0.0:.6g}" for x in values)


def _closed(shape: Wavefront, link: Link) -> Wavefront:
    """The model with a part that is open in it shut."""
    if link.ajar == 0.0:
        return shape
    turn, shift = np.eye(3), -link.ajar * link.axis
    if link.kind == "revolute":
        turn = Rotation.from_rotvec(shift).as_matrix()
        shift = link.origin - turn @ link.origin
    return replace(shape, vertices=shape.vertices @ turn.T + shift, normals=shape.normals @ turn.T)


def _parts(
    shape: Wavefront, faces: Bool[np.ndarray, " F"], labelled: Mapping[str, Bool[np.ndarray, " F"]]
) -> Iterator[tuple[str, Bool[np.ndarray, " F"]]]:
    """Names and faces of a link's visuals: every handle on its own, panes, and the rest."""
    rest = faces.copy()
    for label, of_label in labelled.items():
        found = faces & of_label
        rest &= ~found
        if label == "glass" and found.any():
            yield label, found
        elif found.any():
            for n, grip in enumerate(_apart(shape, found)):
                yield f"{label}{n + 1}", grip
    if rest.any():
        yield "body", rest


def _apart(shape: Wavefront, faces: Bool[np.ndarray, " F"]) -> Iterator[Bool[np.ndarray, " F"]]:
    """Faces whose connected pieces come near each other, together."""
    piece, bounds = shape.pieces
    if len(np.unique(piece[faces])) > _MOST_PIECES:
        yield faces
        return
    clusters: list[tuple[list[int], np.ndarray]] = []
    for each in np.unique(piece[faces]):
        members, box = [int(each)], bounds[each]
        near = [c for c in clusters if (np.maximum(c[1][0] - box[1], box[0] - c[1][1]) < _GRIP_GAP_M).all()]
        for cluster in near:
            clusters = [c for c in clusters if c is not cluster]
            members += cluster[0]
            box = np.array([np.minimum(box[0], cluster[1][0]), np.maximum(box[1], cluster[1][1])])
        clusters.append((members, box))
    for members, _ in clusters:
        yield faces & np.isin(piece, members)


def _add_tray(element: ElementTree.Element, link: Link) -> None:
    """Bottom, back and sides behind a drawer's front."""
    if link.tray is None:
        return
    (x0, y0, z0), (x1, y1, z1) = link.tray
    t, width, top = _TRAY_WALL_M, y1 - y0, z0 + 0.75 * (z1 - z0)
    y0, y1, z0 = y0 + 0.05 * width, y1 - 0.05 * width, z0 + 0.1 * (z1 - z0)
    walls = {
        "bottom": ((x0, y0, z0), (x1, y1, z0 + t)),
        "back": ((x0, y0, z0), (x0 + t, y1, top)),
        "left": ((x0, y0, z0), (x1, y0 + t, top)),
        "right": ((x0, y1 - t, z0), (x1, y1, top)),
    }
    for name, (low, high) in walls.items():
        visual = ElementTree.SubElement(element, "visual", name=f"{link.name}-tray-{name}")
        middle = (np.array(low) + np.array(high)) / 2 - link.origin
        ElementTree.SubElement(visual, "origin", xyz=_words(middle))
        geometry = ElementTree.SubElement(visual, "geometry")
        ElementTree.SubElement(geometry, "box", size=_words(np.array(high) - np.array(low)))
        material = ElementTree.SubElement(visual, "material", name="tray")
        ElementTree.SubElement(material, "color", rgba=_TRAY_RGBA)
