"""A stream that people correct while it runs: frames in, shots for pages out, edits in between."""

from __future__ import annotations

import json
import queue
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Literal, TextIO

import cv2
import numpy as np
import torch
from jaxtyping import UInt8

from quest.data.frame_source import FrameSource
from quest.errors import InputError
from quest.filter import step as filtering
from quest.filter.step import FilterState
from quest.geometry import project, transform
from quest.track import Stream, StreamState, Tracker
from quest.track.events import Event, Events
from quest.track.state_lines import StateLines, state_line
from quest.track.tracker import DEFAULT_ALPHA
from quest.types import Camera, Frame, Query
from quest.viz.joint_lines import state_lines
from quest.viz.palette import query_colour

_REMEMBERED_S = 3.0
"""How old a page's picture may be when somebody has pointed at it, or dragged a box over it, seconds; the last two
pictures may be older."""
_RATE_FRAMES = 20
_IDLE_S = 0.05
_QUALITY = 80


@dataclass(frozen=True)
class Edit:
    """What somebody asks of a running stream."""

    do: Literal["point", "label", "text", "retire", "rename", "place", "confirm", "pause", "resume"]
    """``point``, ``label`` and ``text`` follow something new; ``place`` says where a query's entity is, ``confirm``
    that its answer is right; ``pause`` follows nothing until ``resume``."""
    query: int = -1
    """Number of the query that is meant."""
    frame: int = -1
    """Index of the frame in which a pixel is meant."""
    x: float = 0.0
    """Pixel of the source."""
    y: float = 0.0
    """Likewise."""
    name: str = ""
    """Of the new query, or the new name of one."""
    label: str | None = None
    """Of the new query."""
    words: str = ""
    """Of a text."""


@dataclass(frozen=True)
class Shot:
    """What a page shows of a frame."""

    header: str
    """JSON: the stream's answers as one of its lines (``docs/monitor.md``), and what is drawn beside them: colours,
    lines of joints, events, queries that wait."""
    jpeg: bytes


class Session:
    """Steps a stream through a source, shows every frame, and takes edits between frames.

    Without queries it finds entities, in later frames too. The folder ``record`` gets ``frames.jsonl`` (the answers, a
    line a frame) and ``edits.jsonl`` (what was asked, with the frame). All else is as in
    :meth:`quest.track.Tracker.stream`.

    Raises:
        InputError: a query is not as expected.
    """

    def __init__(
        self,
        tracker: Tracker,
        source: FrameSource,
        queries: Sequence[Query] | None,
        *,
        alpha: float | None = DEFAULT_ALPHA,
        alpha_frames: int | None = None,
        wait: bool = False,
        record: Path | None = None,
    ) -> None:
        self.source = source
        self._tracker = tracker
        self.stream: Stream = tracker.stream(
            source.camera, queries, online=queries is None, wait=wait, alpha=alpha, alpha_frames=alpha_frames
        )
        self.state: StreamState | None = None
        self.events = Events()
        self._record = record
        self._asked: queue.Queue[tuple[Edit, Future[str]]] = queue.Queue()
        self._shown: Callable[[Shot], object] = lambda shot: None
        self._recent: deque[tuple[int, float, FilterState]] = deque()
        self._ends_s: deque[float] = deque(maxlen=_RATE_FRAMES)
        self._stopped = self._paused = False

    def warm_up(self) -> None:
        """Do once what takes longer the first time, on grey pictures and another stream, ahead of the first frame."""
        camera = self.source.camera
        grey = np.full((camera.height, camera.width, 3), 128, np.uint8)
        stream = self._tracker.stream(camera, [Query.point(0, 0, 0)], alpha=None)
        for t in range(2):
            stream.step(grey, None, float(t))
        self._tracker.find(grey)

    def on_shot(self, callback: Callable[[Shot], object]) -> None:
        """Show every frame with a function, which is called in the thread of :meth:`run`."""
        self._shown = callback

    def ask(self, edit: Edit) -> Future[str]:
        """Ask for an edit, from any thread; the future has its words when it is done, or its InputError."""
        done: Future[str] = Future()
        self._asked.put((edit, done))
        return done

    def stop(self) -> None:
        """End :meth:`run` after the frame that it is at, from any thread."""
        self._stopped = True

    def run(self) -> Iterator[tuple[Event, ...]]:
        """Go through the source; gives what happened in each frame.

        Raises:
            RecordingError: the source fails.
            InputError: what is recorded cannot be written.
        """
        with ExitStack() as stack:
            lines = edits = None
            if self._record is not None:
                lines = stack.enter_context(StateLines(self._record / "frames.jsonl"))
                edits = stack.enter_context((self._record / "edits.jsonl").open("w", encoding="utf-8"))
            for frame in self.source:
                self._take_edits(edits)
                while self._paused and not self._stopped:
                    time.sleep(_IDLE_S)
                    self._take_edits(edits)
                if self._stopped:
                    return
                number = self.stream.frame
                self.state = self.stream.step(frame.rgb, frame.depth_m, frame.stamp_s, frame.cam_from_world)
                if lines is not None:
                    lines.write(self.state, frame=number)
                yield self._show(number, frame, self.state)
            self._take_edits(edits)

    def _show(self, number: int, frame: Frame, answer: StreamState) -> tuple[Event, ...]:
        self._ends_s.append(time.monotonic())
        filtered = self.stream.memory.filter
        if filtered is not None:
            blind = self._recent and self._recent[-1][2].stamp_s == filtered.stamp_s
            state = self._recent[-1][2] if blind else _compact(filtered)
            self._recent.append((number, self._ends_s[-1], state))
        while len(self._recent) > 2 and self._ends_s[-1] - self._recent[0][1] > _REMEMBERED_S:
            self._recent.popleft()
        took_s = self._ends_s[-1] - self._ends_s[0]
        events = self.events.step(number, answer)
        header = {
            "frame": number,
            "state": json.loads(state_line(answer, frame=number)),
            "colours": [query_colour(n) for n in answer.query],
            "joints": drawn_joints(answer, self.source.camera),
            "waiting": [{"query": w.number, "words": str(w.query)} for w in self.stream.memory.queries.waiting],
            "events": [asdict(event) for event in events],
            "notes": list(self.source.flags),
            "rate": (len(self._ends_s) - 1) / took_s if took_s > 0 else None,
            "watched": self.stream.budget is not None,
            "size": [self.source.camera.width, self.source.camera.height],
        }
        self._shown(Shot(json.dumps(header, allow_nan=False), to_jpeg(frame.rgb)))
        return events

    def _take_edits(self, record: TextIO | None) -> None:
        """Do what was asked, in order; what is refused changes nothing."""
        while True:
            try:
                edit, done = self._asked.get_nowait()
            except queue.Empty:
                return
            try:
                said = self._do(edit)
            except InputError as error:
                done.set_exception(error)
                continue
            if record is not None:
                record.write(json.dumps({"next_frame": self.stream.frame, "edit": asdict(edit)}) + "\n")
                record.flush()
            done.set_result(said)

    def _do(self, edit: Edit) -> str:
        stream, do = self.stream, edit.do
        if do in ("pause", "resume"):
            self._paused = do == "pause"
            return "paused: nothing is followed" if self._paused else "goes on"
        if do == "retire":
            stream.retire(edit.query)
            return "followed no longer"
        if do == "rename":
            stream.rename(edit.query, edit.name)
            return f"is called {edit.name} from now on"
        if do == "confirm":
            stream.confirm(edit.query)
            return "confirmed"
        if do == "label":
            stream.add(Query.semantic(edit.label or "", edit.name))
            return f"looks for a {edit.label}"
        if do == "text":
            stream.add(Query.text(edit.words, edit.name))
            return f"looks for {edit.words}"
        x, y = self._now(edit)
        number = edit.query
        if do == "point":
            number = stream.add(Query.point(stream.frame, x, y, name=edit.name, label=edit.label))
        stream.place(number, x, y)  # in the frame that was pointed at, not in the next one
        return "followed" if do == "point" else "followed from there"

    def _now(self, edit: Edit) -> tuple[float, float]:
        """Where a pixel of a recent frame is in the newest one.

        Raises:
            InputError: the frame is too old, or the pixel is outside.
        """
        at = next((i for i, (number, *_) in enumerate(self._recent) if number == edit.frame), None)
        if at is None:
            raise InputError(f"frame {edit.frame} is over; point at a newer picture, or pause first")
        uv_px, size = np.array([[edit.x, edit.y]], np.float64), (self.stream.camera.width, self.stream.camera.height)
        if not (np.isfinite(uv_px).all() and (uv_px >= 0).all() and (uv_px <= size).all()):
            raise InputError(f"expected a pixel within {size[0]} x {size[1]}, got ({edit.x:.1f}, {edit.y:.1f})")
        warp, states = np.eye(3), [state for *_, state in self._recent][at:]
        for before, after in pairwise(states):
            warp = warp if after is before else after.warp @ warp
        x, y = filtering.carry(states[0], states[-1], warp, uv_px)[0].clip((0, 0), size).tolist()
        return x, y


def _compact(state: FilterState) -> FilterState:
    """The same, its picture without what was computed from it: half the memory."""
    return replace(state, picture=state.picture.described(state.picture.descriptors))


def drawn_joints(state: StreamState, camera: Camera) -> list[dict[str, list[list[float]]] | None]:
    """Where the joint of each query is in the picture, as lines of pixels; None without a joint or a camera pose.

    ``path`` goes over the range that was seen, ``axis`` is that of turning; what is not all ahead of the camera is left
    out.
    """
    found: list[dict[str, list[list[float]]] | None] = []
    for lines in state_lines(state):
        if lines is None or state.cam_from_world is None:
            found.append(None)
            continue
        pose, drawn = torch.from_numpy(np.asarray(state.cam_from_world, np.float64)), {}
        for name, line in (("path", lines.path), ("axis", lines.axis)):
            if line is not None:
                uv_px = project(transform(pose[None], torch.from_numpy(line)), camera).numpy()
                if np.isfinite(uv_px).all():
                    drawn[name] = np.round(uv_px, 1).tolist()
        found.append(drawn)
    return found


def to_jpeg(rgb: UInt8[np.ndarray, "H W 3"]) -> bytes:
    """A picture as a page shows it."""
    _, data = cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return data.tobytes()
