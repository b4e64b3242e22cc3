"""Streams as bytes: saved, kept anywhere, and gone on with later or elsewhere."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from quest.errors import InputError

FORMAT = "quest-stream-10"
_KEY = "quest-stream"


@dataclass(frozen=True)
class SavedStream:
    """A stream outside of a process.

    Attributes:
        maker: weights, settings and camera that it belongs to.
        alpha: of its alarms; None without.
        alpha_frames: that alpha is for; None for the whole stream.
        words: its state that JSON can hold.
        arrays: the rest of its state.
    """

    maker: dict[str, Any]
    alpha: float | None
    alpha_frames: int | None
    words: dict[str, Any]
    arrays: dict[str, np.ndarray]

    def to_bytes(self) -> bytes:
        """A safetensors file; the same state gives the same bytes."""
        header = {"format": FORMAT} | {f.name: getattr(self, f.name) for f in fields(self) if f.name != "arrays"}
        arrays = {key: np.asarray(value, order="C") for key, value in self.arrays.items()}
        # One entry: the order of several is not fixed.
        return save(arrays, metadata={_KEY: json.dumps(header, sort_keys=True, default=_plain)})

    @classmethod
    def from_bytes(cls, data: bytes) -> SavedStream:
        """Read what :meth:`to_bytes` gave.

        Raises:
            InputError: the bytes are torn or are no saved stream.
        """
        try:
            arrays = load(data)
            length = int.from_bytes(data[:8], "little")
            header = json.loads(json.loads(data[8 : 8 + length])["__metadata__"][_KEY])
        except (SafetensorError, KeyError, ValueError) as error:
            raise InputError(
                f"saved stream: expected the bytes of Stream.save(), got {len(data)} bytes that are not ({error})"
            ) from error
        if header.get("format") != FORMAT:
            raise InputError(f"saved stream: expected format {FORMAT!r}, got {header.get('format')!r}")
        return cls(header["maker"], header["alpha"], header["alpha_frames"], header["words"], arrays)


def _plain(value: Any) -> Any:
    """A number of numpy as Python's: what cameras and queries were given."""
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} is no number")
