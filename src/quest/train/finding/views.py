"""Views: what the finder learns from, a square each.

A view is a picture scaled, mirrored, cut and degraded at random. Where the transformer stays as it is, some views of
every picture are kept in a folder with what it sees in them, because that takes most of the time. Where it learns,
pictures are kept, and a view is drawn whenever one is learned from. What else is random comes after that
(:mod:`quest.train.finding.sampler`).
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from zipfile import BadZipFile

import cv2
import numpy as np
import torch
from jaxtyping import UInt8

from quest.data.boxed_pictures import CLASSES, BoxedPicture, kind_of
from quest.data.pictures import decode_picture
from quest.data.provenance import file_hash
from quest.data.store import TakeStore
from quest.errors import ConfigError
from quest.model.finder import PLACES, FinderNetwork
from quest.model.weights import weights_digest
from quest.train.finding.marks import KINDS, UNKNOWN, Marks
from quest.train.finding.settings import VIEW_PX
from quest.train.finding.takes import marks_of
from quest.types import Take
from quest.whole_file import whole_file

_LONGER_PX = (450.0, 1200.0)
"""Longer side of the scaled picture."""
_ASPECT = 1.1
_VERSION = 3
"""Of how views are made; another one makes all of them again."""


@dataclass(frozen=True)
class Source:
    """Where views come from: a picture, or a frame of a take."""

    name: str
    """Digest of its picture and marks: what changed has other views."""
    where: str
    """What people call it."""
    read: Callable[[], tuple[bytes, Marks]]
    """Contents of an image file, and marks."""


def of_pictures(pictures: Sequence[BoxedPicture], *, only: Sequence[bool]) -> list[Source]:
    """Labelled pictures as sources.

    Kinds count as labelled throughout that any picture has; a set without knobs calls them handles.

    Args:
        pictures: a whole set.
        only: which of them are wanted.

    Raises:
        ConfigError: no class is one that the finder knows.
    """
    if not pictures:
        return []
    classes = {name for picture in pictures for name in picture.names}
    known = {name: kind for name in classes if (kind := kind_of(name))[0]}
    if not known:
        raise ConfigError(
            f"pictures: expected classes such as {', '.join(CLASSES)}, got {', '.join(sorted(classes)) or 'none'}"
        )
    labelled = np.isin(KINDS, [kind for kind, _ in known.values()])
    tells_knobs = any(knob for _, knob in known.values())

    def reader(picture: BoxedPicture) -> Callable[[], tuple[bytes, Marks]]:
        def read() -> tuple[bytes, Marks]:
            rows = [i for i, name in enumerate(picture.names) if name in known]
            kind = np.array([KINDS.index(known[picture.names[i]][0]) for i in rows], np.int64)
            told = [known[picture.names[i]][1] if tells_knobs else None for i in rows]
            knob = np.array([UNKNOWN if k is None else int(k) for k in told], np.int64)
            unknown = np.full(len(rows), UNKNOWN)
            # What one takes hold of in a picture of a room opens something.
            lift = np.where(kind < len(PLACES), 0, UNKNOWN)
            box = picture.box_px[rows]
            middle = (box[:, :2] + box[:, 2:]) / 2
            return picture.path.read_bytes(), Marks(kind, box, middle, knob, lift, unknown, known=labelled)

        return read

    told = repr(sorted(known.items()))
    return [
        Source(
            _digest(file_hash(picture.path), picture.names, picture.box_px.tolist(), told),
            f"picture {picture.path}",
            reader(picture),
        )
        for picture, wanted in zip(pictures, only, strict=True)
        if wanted
    ]


def of_takes(store: TakeStore, names: Sequence[str], *, frames: int) -> list[Source]:
    """Frames of takes as sources.

    Args:
        store: where they are.
        names: of the takes.
        frames: how many of each view, spread over its time; the first is one of them.
    """
    sources = []

    @lru_cache(maxsize=1)  # its frames come one after the other
    def taken(name: str, until: int) -> Take:
        return store.read(name, frames=slice(0, until))

    for name in names:
        header = store.header(name)
        picked = np.unique(np.linspace(0, header.frames, frames, endpoint=False).astype(int)).tolist()
        for v in range(len(header.cameras)):
            for t in picked:

                def read(name: str = name, until: int = picked[-1] + 1, v: int = v, t: int = t) -> tuple[bytes, Marks]:
                    take = taken(name, until)
                    return _encoded(take.views[v].clip.rgb[t]), marks_of(take, take.views[v], t)

                sources.append(Source(_digest(header.data_hash, v, t), f"frame {t} of {name}", read))
    return sources


@dataclass(frozen=True)
class View:
    """A square cut of a picture."""

    rgb: UInt8[np.ndarray, "S S 3"]
    """Colours."""
    marks: Marks
    """What is labelled in it."""
    context: np.ndarray | None = None
    """What the transformer sees in it, float16 [E, r, c]; None where it learns."""


class ViewCache:
    """A folder of views; what is there is not made again.

    Args:
        folder: where; one below it for every transformer.
        network: whose transformer looks.
    """

    def __init__(self, folder: Path, network: FinderNetwork) -> None:
        self._network = network
        self._folder = folder / weights_digest(network.encoder)[:16]

    def build(self, source: Source, *, views: int) -> Iterator[Path]:
        """Files of the views of a source, one after the other as they are there."""
        paths = [self._folder / f"{source.name}-{number}.npz" for number in range(views)]
        picture = None
        for number, path in enumerate(paths):
            if not path.is_file():
                if picture is None:
                    contents, marks = source.read()
                    picture = _decoded(contents, source), marks
                rgb, moved = draw_view(*picture, np.random.default_rng([int(source.name, 16), number]))
                _write(path, moved, rgb=rgb, context=self._look(rgb))
            yield path

    def _look(self, rgb: UInt8[np.ndarray, "S S 3"]) -> np.ndarray:
        image = torch.from_numpy(rgb).permute(2, 0, 1)[None].to(next(self._network.parameters()).device) / 255
        return self._network.context_of(image)[0].half().cpu().numpy()


class PictureCache:
    """A folder of pictures and their marks, no larger than a view can show them; what is there is not made again.

    Args:
        folder: where; one below it.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder / "pictures"

    def build(self, source: Source) -> Path:
        """The file of a source."""
        path = self._folder / f"{source.name}.npz"
        if not path.is_file():
            contents, marks = source.read()
            rgb = _decoded(contents, source)
            size = np.array([rgb.shape[1], rgb.shape[0]])
            smaller = np.maximum(1, np.round(size * _LONGER_PX[1] / size.max()).astype(int))
            if (smaller < size).any():
                contents = _encoded(cv2.resize(rgb, tuple(smaller.tolist()), interpolation=cv2.INTER_AREA))
                marks = marks.warped(smaller / size, np.zeros(2), (int(smaller[0]), int(smaller[1])))
            _write(path, marks, image=np.frombuffer(contents, np.uint8))
        return path


def _digest(*parts: object) -> str:
    return hashlib.sha256(repr((_VERSION, *parts)).encode()).hexdigest()[:20]


def _decoded(contents: bytes, source: Source) -> UInt8[np.ndarray, "H W 3"]:
    return decode_picture(BytesIO(contents), source.where)


def _encoded(rgb: UInt8[np.ndarray, "H W 3"]) -> bytes:
    """A JPEG file, by eye the same; views are compressed anew, and more, half of the time."""
    return cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()


def read_view(path: Path) -> View:
    """A view of a cache.

    Raises:
        ConfigError: the file is torn.
    """
    arrays, marks = _read(path, "rgb", "context")
    return View(arrays["rgb"], marks, arrays["context"])


def read_whole(path: Path) -> tuple[UInt8[np.ndarray, "H W 3"], Marks]:
    """A picture of a cache.

    Raises:
        ConfigError: the file is torn.
    """
    arrays, marks = _read(path, "image")
    return decode_picture(BytesIO(arrays["image"].tobytes()), str(path)), marks


def _read(path: Path, *names: str) -> tuple[dict[str, np.ndarray], Marks]:
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in names}, Marks(**{f.name: file[f.name] for f in fields(Marks)})
    except (OSError, ValueError, KeyError, BadZipFile) as error:
        raise ConfigError(f"{path}: torn ({error}); delete it, it is made again") from error


def _write(path: Path, marks: Marks, **arrays: np.ndarray) -> None:
    with whole_file(path) as unfinished:
        np.savez(unfinished, **arrays, **{f.name: getattr(marks, f.name) for f in fields(Marks)})


def draw_view(
    rgb: UInt8[np.ndarray, "H W 3"], marks: Marks, rng: np.random.Generator
) -> tuple[UInt8[np.ndarray, "S S 3"], Marks]:
    """A picture scaled, mirrored, cut to a square, and degraded."""
    size = np.array([rgb.shape[1], rgb.shape[0]], float)
    longer = np.exp(rng.uniform(*np.log(_LONGER_PX)))
    stretch = _ASPECT ** rng.uniform(-0.5, 0.5)
    scale = longer / size.max() * np.array([stretch, 1 / stretch])
    room = VIEW_PX - size * scale
    shift = rng.uniform(np.minimum(room, 0), np.maximum(room, 0))
    signed, mirrored = scale.copy(), bool(rng.random() < 0.5)
    if mirrored:
        signed[0], shift[0] = -scale[0], shift[0] + size[0] * scale[0]
    fill = rng.integers(0, 256, 3)
    how = cv2.INTER_AREA if scale.max() < 1 else cv2.INTER_LINEAR
    whole = np.maximum(1, np.round(size * scale)).astype(int)
    # Scaled first, so that what shrinks is averaged; then moved by whole pixels.
    view = _cut(cv2.resize(rgb, tuple(whole.tolist()), interpolation=how), mirrored, shift, fill)
    return _degraded(view, rng), marks.warped(signed, shift, (VIEW_PX, VIEW_PX))


def _cut(
    image: UInt8[np.ndarray, "H W 3"], mirrored: bool, shift: np.ndarray, fill: np.ndarray
) -> UInt8[np.ndarray, "S S 3"]:
    """A square out of an image, whose left upper corner (mirrored: right upper) lies at a shift."""
    rows, columns = image.shape[:2]
    image = image[:, ::-1] if mirrored else image
    x, y = np.round(shift).astype(int).tolist()
    x -= columns if mirrored else 0
    out = np.empty((VIEW_PX, VIEW_PX, 3), np.uint8)
    out[:] = fill
    left, top, right, bottom = max(x, 0), max(y, 0), min(x + columns, VIEW_PX), min(y + rows, VIEW_PX)
    out[top:bottom, left:right] = image[top - y : bottom - y, left - x : right - x]
    return out


def _degraded(rgb: UInt8[np.ndarray, "S S 3"], rng: np.random.Generator) -> UInt8[np.ndarray, "S S 3"]:
    """Another exposure, white balance and sharpness, and a real JPEG encoder."""
    if rng.random() < 0.8:
        gain = np.exp(rng.normal(0, 0.15, 3) + rng.normal(0, 0.2))
        gamma = np.exp(rng.normal(0, 0.2))
        table = (255 * (np.arange(256)[:, None] / 255 * gain).clip(0, 1) ** gamma).round().astype(np.uint8)
        rgb = np.stack([table[rgb[..., i], i] for i in range(3)], axis=-1)
    if rng.random() < 0.25:
        rgb = cv2.GaussianBlur(rgb, (0, 0), rng.uniform(0.5, 2.0))
    if rng.random() < 0.5:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(30, 95))]
        decoded = cv2.imdecode(cv2.imencode(".jpg", rgb[..., ::-1], quality)[1], cv2.IMREAD_COLOR)
        assert decoded is not None
        rgb = decoded[..., ::-1]
    return np.ascontiguousarray(rgb)
