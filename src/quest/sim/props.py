"""Props: what stands in a scene beside the object and its surroundings, and may move or change."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import numpy as np


@runtime_checkable
class Prop(Protocol):
    """Something that is put into a scene once and placed anew at every frame of the script."""

    def add(self, scene: Any) -> Any:
        """Put it into a ``sapien.Scene`` that has its lights already; returns what :meth:`place` moves."""
        ...

    def place(self, actors: Any, frame: int) -> None:
        """Bring what :meth:`add` returned to where it is at a frame of the script."""
        ...

    def pose(self, frame: int) -> np.ndarray:
        """Numbers that are the same at two frames if and only if nothing about it differs between them."""
        ...
