"""A furniture library of Sweet Home 3D: a ZIP of a catalogue of properties, and of models with their pictures."""

from __future__ import annotations

import posixpath
import re
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from quest.errors import ObjectError
from quest.untrusted import is_inside, reading, require_file

_CATALOGUE = "PluginFurnitureCatalog.properties"
_MOST_MEMBERS = 50_000
_MOST_BYTES = 32 * 2**20
"""Of one member, unpacked."""
_MOST_BYTES_IN_ALL = 4 * 2**30
_MOST_M = 100.0


@dataclass(frozen=True)
class Model:
    """An entry of the catalogue."""

    path: str
    """Of its Wavefront file in the library."""
    name: str
    creator: str
    licence: str
    """Of the library."""
    section: str
    """Of the catalogue, such as ``Kitchen``."""
    size_m: tuple[float, float, float]
    """Depth, width and height."""
    upright: Float[np.ndarray, "3 3"]
    """Turns the model's axes so that y is up and z the front."""


class Library:
    """An open library; to be used in a ``with`` statement.

    Raises:
        ObjectError: it is no ZIP, has no catalogue, or would unpack to more than is believed.
    """

    def __init__(self, path: Path) -> None:
        require_file(path, ObjectError)
        self.path = path
        with reading(path, ObjectError, "download the library again"):
            self._zip = zipfile.ZipFile(path)
            self._members = {info.filename: info for info in self._zip.infolist() if not info.is_dir()}
        total = sum(info.file_size for info in self._members.values())
        if len(self._members) > _MOST_MEMBERS or total > _MOST_BYTES_IN_ALL:
            raise ObjectError(
                f"{path}: holds {len(self._members)} files of {total} bytes, expected at most {_MOST_MEMBERS} of "
                f"{_MOST_BYTES_IN_ALL}; use another library"
            )
        if _CATALOGUE not in self._members:
            raise ObjectError(f"{path}: has no {_CATALOGUE}, expected a library of Sweet Home 3D; use an .sh3f file")
        text = self.read(_CATALOGUE).decode("latin-1")
        with reading(f"{path}: {_CATALOGUE}", ObjectError, "download the library again"):
            self._properties = _properties(text)

    def __enter__(self) -> Library:
        return self

    def __exit__(self, *_: object) -> None:
        self._zip.close()

    def read(self, name: str) -> bytes:
        """A member's bytes.

        Raises:
            ObjectError: there is none of that name, or it is damaged or too large.
        """
        info = self._members.get(name)
        if info is None or info.file_size > _MOST_BYTES:
            found = "no such file" if info is None else f"{info.file_size} bytes, expected at most {_MOST_BYTES}"
            raise ObjectError(f"{self.path}: {name}: {found}; use another library")
        with reading(f"{self.path}: {name}", ObjectError, "download the library again"):
            return self._zip.read(info)

    def beside(self, path: str, name: str) -> str | None:
        """The member that a file of the library means by a name, upper or lower case, or None."""
        wanted = posixpath.normpath(posixpath.join(posixpath.dirname(path), name.replace("\\", "/")))
        if not is_inside(wanted):
            return None
        if wanted in self._members:
            return wanted
        return next((each for each in self._members if each.lower() == wanted.lower()), None)

    def sums(self, path: str) -> list[str]:
        """Checksums of a member and of all that lies in its folder."""
        folder = posixpath.dirname(path)
        beside = (info for name, info in self._members.items() if posixpath.dirname(name) == folder)
        return sorted(f"{info.filename} {info.CRC} {info.file_size}" for info in beside)

    def models(self) -> Iterator[Model | ObjectError]:
        """Every entry of the catalogue, or what is wrong with it."""
        entries: dict[str, dict[str, str]] = {}
        for key, value in self._properties.items():
            word, _, number = key.partition("#")
            entries.setdefault(number, {})[word] = value
        for number, of_model in entries.items():
            if "model" not in of_model:
                continue
            try:
                with reading(f"{self.path}: model {number}", ObjectError, "it is left out"):
                    yield self._model(of_model)
            except ObjectError as error:
                yield error

    def _model(self, values: Mapping[str, str]) -> Model:
        path = values["model"].lstrip("/")
        if not is_inside(path) or not path.lower().endswith(".obj"):
            raise ValueError(f"model is {path[:80]!r}, expected an .obj file of the library")
        size = [float(values[key]) / 100 for key in ("depth", "width", "height")]
        turn = [float(word) for word in values.get("modelRotation", "1 0 0 0 1 0 0 0 1").split()]
        if not all(0 < s < _MOST_M for s in size) or len(turn) != 9 or not np.isfinite(turn).all():
            raise ValueError(f"its size is {size} m and its rotation {turn}, expected numbers > 0 and nine numbers")
        upright = np.array(turn).reshape(3, 3)
        if not np.allclose(upright @ upright.T, np.eye(3), atol=0.02):
            raise ValueError("its rotation is none")
        return Model(
            path,
            values.get("name") or Path(path).stem,
            values.get("creator") or self._properties.get("provider", "unknown"),
            self._properties.get("license", "unknown"),
            values.get("category", ""),
            (size[0], size[1], size[2]),
            upright,
        )


def _properties(text: str) -> dict[str, str]:
    """Keys and values of Java's format, as far as catalogues use it."""
    found = {}
    for line in re.sub(r"\\\r?\n[ \t]*", "", text).splitlines():
        key, _, value = line.strip().partition("=")
        if key and key[0] not in "#!":
            words = re.sub(r"\\u([0-9a-fA-F]{4})|\\(.)", lambda m: chr(int(m[1], 16)) if m[1] else m[2], value)
            found[key.strip()] = words.strip()
    return found
