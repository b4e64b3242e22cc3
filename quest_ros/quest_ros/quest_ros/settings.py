"""Parameters of the node."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from quest.errors import ConfigError, InputError
from quest.types import Query

RAW, COMPRESSED, COMPRESSED_DEPTH = "raw", "compressed", "compressedDepth"


@dataclass(frozen=True)
class Settings:
    """What the node is told; the fields are its parameters, which are read once, when it begins."""

    weights: str = "quest-s16"
    """Name of shipped weights, a file, or ``owner/name`` on the Hugging Face hub."""
    monitor: str = ""
    """File of ``quest calibrate``; empty for the calibrations that ship."""
    device: str = "auto"
    """``cpu``, ``cuda``, ``cuda:1``, ``mps`` or ``auto``."""
    alpha: float = 0.05
    """Share of streams without any loss that may raise an alarm."""
    alpha_frames: int = 0
    """Alpha is for every so many pictures instead; 0 for the whole stream."""
    labels: tuple[str, ...] = ()
    """Labels to follow from the first picture on, such as ``handle`` or ``rim:lift``."""
    texts: tuple[str, ...] = ()
    """Texts to follow likewise, such as ``the handle of the left door``."""
    points: tuple[str, ...] = ()
    """Pixels of the first picture as ``X,Y`` or ``X,Y,NAME``; the centre of the first pixel is (0, 0)."""
    discover: bool = True
    """Without labels, texts and points: follow what is found in the first picture."""
    online_s: float = 0.0
    """Seconds between looks for what is not followed yet, for as long as the stream lasts; 0 for none."""
    threshold: float = 0.0
    """Probability above which what was found is followed; 0 for that of the weights."""
    use_depth: bool = True
    """Whether there is a topic of depth."""
    image_transport: str = RAW
    """``raw``, or ``compressed`` for sensor_msgs/CompressedImage."""
    depth_transport: str = RAW
    """``raw``, or ``compressedDepth`` for sensor_msgs/CompressedImage."""
    depth_scale_m: float = 0.0
    """Metres per unit of depth; 0 for millimetres in 16 bits and metres in floats."""
    sync_s: float = 0.02
    """Largest difference in time of colours and depth, seconds."""
    world_frame: str = ""
    """Frame of tf that answers are given in; empty for the optical frame of the colours."""
    marker_m: float = 0.03
    """Diameter of the markers, metres."""

    def __post_init__(self) -> None:
        transports = (("image_transport", (RAW, COMPRESSED)), ("depth_transport", (RAW, COMPRESSED_DEPTH)))
        for name, known in transports:
            if getattr(self, name) not in known:
                raise ConfigError(f"{name}: expected {' or '.join(known)}, got {getattr(self, name)!r}")
        for name in ("alpha_frames", "online_s", "depth_scale_m", "sync_s"):
            if not 0 <= getattr(self, name) < np.inf:
                raise ConfigError(f"{name}: expected a number that is not negative, got {getattr(self, name)}")
        if not 0 < self.marker_m < np.inf:
            raise ConfigError(f"marker_m: expected a length in metres above 0, got {self.marker_m}")
        for name in ("alpha", "threshold"):
            if not (0 < getattr(self, name) < 1 or (name == "threshold" and self.threshold == 0)):
                raise ConfigError(f"{name}: expected a probability between 0 and 1, got {getattr(self, name)}")
        self.queries()

    @classmethod
    def from_parameters(cls, values: Mapping[str, Any]) -> Settings:
        """The settings of parameters: empty texts in lists are none, whole numbers are numbers too.

        Raises:
            ConfigError: a value is of another type, or out of its range.
        """
        given = {}
        for field in fields(cls):
            value = values[field.name]
            if isinstance(field.default, tuple):
                value = tuple(text for text in value if text)
            elif isinstance(field.default, float) and isinstance(value, int) and not isinstance(value, bool):
                value = float(value)
            if not isinstance(value, type(field.default)):
                raise ConfigError(f"{field.name}: expected {type(field.default).__name__}, got {value!r}")
            given[field.name] = value
        return cls(**given)

    def queries(self) -> list[Query]:
        """What to follow from the first picture on.

        Raises:
            InputError: a label is unknown, or a point is not written as expected.
        """
        asked = [label_query(label) for label in self.labels]
        return asked + [Query.text(text) for text in self.texts] + [_point(text) for text in self.points]


def label_query(label: str, name: str = "") -> Query:
    """A query by a label, or by a label and an intent such as ``rim:lift``."""
    label, _, intent = label.partition(":")
    return Query.semantic(label, name, intent=intent or None)


def point_query(frame: int, x: float, y: float, *, name: str = "", label: str = "") -> Query:
    """A query by a pixel as ROS counts it, with the centre of the first pixel at (0, 0)."""
    return Query.point(frame, x + 0.5, y + 0.5, name=name, label=label or None)


def _point(text: str) -> Query:
    parts = text.split(",", 2)
    try:
        x, y = float(parts[0]), float(parts[1])
    except (ValueError, IndexError) as error:
        raise InputError(f"points: {text!r}: expected X,Y or X,Y,NAME, such as 120,88") from error
    return point_query(0, x, y, name=parts[2] if len(parts) > 2 else "")
