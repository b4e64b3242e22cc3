"""Pictures with boxes around things, as people label them: COCO, YOLO, or a table ``labels.csv``."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from jaxtyping import Bool, Float
from PIL import Image

from quest.data.columns import read_columns
from quest.data.pictures import PICTURES, is_turned, upright
from quest.errors import InputError
from quest.untrusted import is_inside, read_json, reading

EXPECTED = (
    "expected a COCO file (.json), a YOLO data set (its data.yaml or the folder of that), or a folder with pictures/ "
    "and labels.csv"
)
_CHOOSING_EVERY = 5
_OUT_PX, _OUT = 4.0, 0.125
CLASSES: dict[str, tuple[str, bool | None]] = {
    **dict.fromkeys(("handle", "grip", "door handle", "drawer handle", "pull"), ("grip", False)),
    **dict.fromkeys(("knob", "door knob"), ("grip", True)),
    **dict.fromkeys(("cabinet door", "cabinet", "drawer", "cupboard door"), ("cabinet", None)),
    **dict.fromkeys(("door", "room door"), ("door", None)),
    **dict.fromkeys(("refrigerator door", "fridge door"), ("refrigerator", None)),
}
"""What the finder takes classes of labels for: a grip or a kind of panel, and whether a grip is a knob."""


@dataclass(frozen=True)
class BoxedPicture:
    """A picture and what is boxed in it."""

    path: Path
    names: tuple[str, ...]
    """Class of each box, as the labels say it."""
    box_px: Float[np.ndarray, "N 4"]
    """Left, top, right and bottom edges, pixels."""
    licence: str = ""
    """Of the picture; empty where the labels do not say."""


def read_boxed_pictures(path: Path) -> list[BoxedPicture]:
    """Read a labelled set: a COCO file; ``data.yaml`` of a YOLO set, or its folder; or a folder with ``pictures``.

    The last has ``labels.csv`` with columns file, class, x0, y0, x1, y1 and, if there is one, licence.

    Raises:
        InputError: it is none of these, or a label cannot be understood.
    """
    config = next((file for name in ("data.yaml", "data.yml") if (file := path / name).is_file()), None)
    if path.suffix == ".json" and path.is_file():
        found = list(_coco(path))
    elif path.suffix in (".yaml", ".yml") and path.is_file():
        found = list(_yolo(path.parent, path))
    elif (path / "labels.csv").is_file():
        found = list(_table(path))
    elif config is not None:
        found = list(_yolo(path, config))
    else:
        raise InputError(f"pictures {path}: {EXPECTED}")
    if not found:
        raise InputError(f"pictures {path}: it names no picture; {EXPECTED}")
    for picture in found:
        if not picture.path.is_file():
            raise InputError(f"pictures {path}: expected a picture {picture.path}, found none")
        if not np.isfinite(picture.box_px).all() or (picture.box_px[:, 2:] < picture.box_px[:, :2]).any():
            raise InputError(f"pictures {path}: expected boxes with finite edges in order for {picture.path.name}")
    return found


def kind_of(name: str) -> tuple[str, bool | None]:
    """What a class of labels is, as in :data:`CLASSES`; nothing for others."""
    return CLASSES.get(name.strip().lower(), ("", None))


def in_boxes(box_px: Float[np.ndarray, "H 4"], uv_px: Float[np.ndarray, "A 2"]) -> Bool[np.ndarray, "A H"]:
    """Which points are right about which boxes: inside, where every edge is moved out by an eighth, at least 4 px."""
    low, high = box_px[:, :2], box_px[:, 2:]
    out = np.maximum(_OUT_PX, _OUT * (high - low))
    return np.asarray(((uv_px[:, None] >= low - out) & (uv_px[:, None] <= high + out)).all(axis=-1))


def may_choose(picture: str) -> bool:
    """Whether a picture is of the fifth that chooses, by the hash of its name; those of one building stay together."""
    group = "ward" if picture.startswith("ward-") else picture
    return int(hashlib.sha256(group.encode()).hexdigest(), 16) % _CHOOSING_EVERY == 0


def _table(folder: Path) -> Iterator[BoxedPicture]:
    edges = ("x0", "y0", "x1", "y1")
    rows = read_columns(folder / "labels.csv", {"file": str, "class": str, **dict.fromkeys(edges, float)}, licence=str)
    file, name, licence = (rows[key] for key in ("file", "class", "licence"))
    box = np.stack([rows[key] for key in edges], axis=-1)
    for picture in np.unique(file[file != ""]).tolist():
        _check_inside(picture, folder / "labels.csv")
        own = file == picture
        boxed = own & (name != "")
        yield BoxedPicture(folder / "pictures" / picture, tuple(name[boxed]), box[boxed], str(licence[own][0]))


def _check_inside(file: str, where: Path) -> None:
    if not is_inside(file):
        raise InputError(f"{where}: {file!r} is no picture of its folder; name pictures below it")


def _coco(path: Path) -> Iterator[BoxedPicture]:
    remedy = "expected a COCO file with images, annotations and categories"
    raw = read_json(path, InputError, remedy)
    with reading(path, InputError, remedy):
        names = {category["id"]: str(category["name"]) for category in raw["categories"]}
        licences = {licence["id"]: str(licence.get("name", "")) for licence in raw.get("licenses", ())}
        boxes: dict[int, list[tuple[str, list[float]]]] = {}
        for mark in raw["annotations"]:
            x, y, width, height = map(float, mark["bbox"])
            boxes.setdefault(mark["image_id"], []).append((names[mark["category_id"]], [x, y, x + width, y + height]))
        images = [(each["id"], str(each["file_name"]), licences.get(each.get("license"), "")) for each in raw["images"]]
    for number, file, licence in images:
        _check_inside(file, path)
        beside = [folder / file for folder in (path.parent, path.parent / "images", path.parent.parent / "images")]
        place = next((p for p in beside if p.is_file()), beside[0])
        own = boxes.get(number, [])
        yield _boxed(place, own, licence)


def _yolo(folder: Path, config: Path) -> Iterator[BoxedPicture]:
    with reading(config, InputError, "expected the names of the classes under 'names'"):
        names = yaml.safe_load(config.read_text(encoding="utf-8"))["names"]
        names = {int(k): str(v) for k, v in (names.items() if isinstance(names, dict) else enumerate(names))}
    images = sorted(p for p in (folder / "images").rglob("*") if p.suffix.lower() in PICTURES)
    images = images or sorted(p for p in folder.rglob("images/*") if p.suffix.lower() in PICTURES)
    for path in images:
        parts = list(path.parts)
        at = len(parts) - 1 - parts[::-1].index("images")
        labels = Path(*parts[:at], "labels", *parts[at + 1 :]).with_suffix(".txt")
        with reading(path, InputError), Image.open(path) as image:
            size = (upright(image) if is_turned(image) else image).size
        own: list[tuple[str, list[float]]] = []
        with reading(labels, InputError):
            lines = labels.read_text(encoding="utf-8").splitlines() if labels.is_file() else []
        for line in filter(str.strip, lines):
            with reading(f"{labels}: {line!r}", InputError, "expected a class and its box"):
                number, *values = line.split()
                xy = np.array([float(value) for value in values])
                if len(xy) == 4:
                    low, high = xy[:2] - xy[2:] / 2, xy[:2] + xy[2:] / 2
                else:  # an outline
                    low, high = xy.reshape(-1, 2).min(axis=0), xy.reshape(-1, 2).max(axis=0)
                own.append((names[int(number)], [*(low * size).tolist(), *(high * size).tolist()]))
        yield _boxed(path, own)


def _boxed(path: Path, own: list[tuple[str, list[float]]], licence: str = "") -> BoxedPicture:
    box_px = np.array([box for _, box in own], np.float64).reshape(-1, 4)
    return BoxedPicture(path, tuple(name for name, _ in own), box_px, licence)
