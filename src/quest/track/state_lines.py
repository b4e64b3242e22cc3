"""A stream's answers as JSON Lines, for programs that follow along."""

from __future__ import annotations

import contextlib
import json
import os
import sys
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO

import numpy as np

from quest.errors import InputError
from quest.filter.joints import Joint, JointKind
from quest.track.state import StreamState

STANDARD_OUTPUT = Path("-")


def state_line(state: StreamState, *, frame: int) -> str:
    """A stream's answer to a frame as one line of JSON, without the line's end; what is unknown (NaN) is null.

    Numbers that the tracker computes have six significant digits. The fields are listed in ``docs/monitor.md``.
    """
    queries = [
        {
            "query": number,
            "name": state.names[k],
            "label": state.labels[k],
            "state": state.state[k].value,
            "visible": bool(state.visible[k]),
            "uv_px": _plain(state.uv_px[k]),
            "point_world": _plain(state.point_world[k]),
            "confidence": _number(state.confidence[k]),
            "lost_p": _number(state.lost_p[k]),
            "joint": _joint(state.joint[k], state.q[k]),
            "alarm": None if (alarm := state.alarm[k]) is None else asdict(alarm),
        }
        for k, number in enumerate(state.query)
    ]
    line = {"frame": frame, "stamp_s": float(state.stamp_s), "flags": list(state.flags), "queries": queries}
    return json.dumps(line, allow_nan=False)


class StateLines:
    """Writes one line per frame, each at once, so that another program can follow; a context manager.

    Args:
        path: file to write anew; its folder is made. ``-`` is standard output.

    Raises:
        InputError: the file cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: TextIO = sys.stdout
        if path != STANDARD_OUTPUT:
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                self._file = path.open("w", encoding="utf-8")
            except OSError as error:
                raise InputError(f"--jsonl {path}: cannot be written ({error.strerror}); name another file") from error

    def __enter__(self) -> StateLines:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._path != STANDARD_OUTPUT:
            # Every line is flushed: what closing could still complain about has been reported.
            with contextlib.suppress(OSError):
                self._file.close()

    def write(self, state: StreamState, *, frame: int) -> None:
        """Write one frame.

        Raises:
            InputError: nobody reads standard output any more, or the disk is full.
        """
        try:
            self._file.write(state_line(state, frame=frame) + "\n")
            self._file.flush()
        except OSError as error:
            if self._path == STANDARD_OUTPUT:
                # Python flushes standard output once more when it ends, and would complain again.
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise InputError(
                f"--jsonl {self._path}: frame {frame} cannot be written ({error.strerror}); stopped there"
            ) from error


def _joint(joint: Joint | None, q: np.floating) -> dict[str, Any] | None:
    if joint is None:
        return None
    moves = joint.kind is not JointKind.STATIC
    return {
        "kind": joint.kind.value,
        "axis": _plain(joint.axis) if moves else None,
        "origin_m": _plain(joint.origin),
        "q": _number(q),
        "q_seen": [_number(joint.lower), _number(joint.upper)] if moves else None,
    }


def _plain(values: np.ndarray) -> list[float | None]:
    return [_number(value) for value in values]


def _number(value: float | np.floating) -> float | None:
    return float(f"{value:.6g}") if np.isfinite(value) else None
