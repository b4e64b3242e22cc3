"""Made-up records: one entity's answers, frame by frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quest.evaluation import EntityRecord, Run, Subject
from quest.evaluation.bootstrap import Value

RUN = Run("quest eval", "abc", "def", None, None, 50, 0, "machine", {"python": "3"}, "2026-01-01T00:00:00", 1.0)


def known(value: Value | None) -> Value:
    """A value that is there."""
    assert value is not None
    return value


def mean(value: Value | None) -> float:
    """The middle of a value that is there."""
    return known(value).mean


def make_answer(
    distance: Sequence[float] | np.ndarray,
    *,
    tracker: str = "quest",
    object_id: str = "desk-102015",
    take: str | None = None,
    entity: int = 1,
    view: int = 0,
    moved: bool = True,
    first_frame: int = 0,
    follows: Sequence[int] | np.ndarray | None = None,
    visible: Sequence[bool] | np.ndarray | None = None,
    level: int = 1,
    protocol: str = "point",
) -> EntityRecord:
    """A record that follows its own entity, which is always visible, unless told otherwise."""
    frames = len(distance)
    return EntityRecord(
        subject=Subject(tracker, protocol, "validation", "procedural", level, object_id),
        take=take or f"{object_id}-L{level}-s000000",
        view=view,
        entity=entity,
        name=f"link_{entity}/handle",
        label="handle",
        moved=moved,
        found=True,
        first_frame=first_frame,
        distance=np.array(distance, np.float32),
        distance_px=np.zeros(frames, np.float32),
        follows=np.full(frames, entity, np.int16) if follows is None else np.array(follows, np.int16),
        visible=np.ones(frames, bool) if visible is None else np.array(visible, bool),
    )
