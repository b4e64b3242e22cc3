"""Queries picked on a recording: its frames, what the finder sees in them, a preview, and the file that is saved."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quest.data.frame_source import FrameSource, source_of_clip
from quest.data.queries_file import write_queries
from quest.errors import InputError, QuestError
from quest.live.server import Feed, Handler, read_message
from quest.live.session import Session, to_jpeg
from quest.track import Tracker
from quest.types import LABELS, Clip, Query

if TYPE_CHECKING:
    from aiohttp import web

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Picked:
    """What a page sends."""

    queries: tuple[Query, ...]


class Picking:
    """What the page of ``quest pick`` asks for; the tracker finds, and follows in the preview."""

    def __init__(self, tracker: Tracker, clip: Clip, queries: Sequence[Query], out: Path) -> None:
        self._tracker, self._clip, self._queries, self._out = tracker, clip, list(queries), out
        self._feed = Feed()
        self._preview: tuple[Session, threading.Thread] | None = None
        self.saved = 0
        self.done = threading.Event()

    @property
    def routes(self) -> Mapping[str, Handler]:
        """For :class:`quest.live.server.Server`."""
        return {
            "GET /start": self._start,
            "GET /frame/{t:\\d+}": self._frame,
            "GET /found/{t:\\d+}": self._found,
            "GET /feed": self._feed.serve,
            "POST /preview": self._begin_preview,
            "POST /stop": self._end_preview,
            "POST /save": self._save,
            "POST /done": self._finish,
        }

    def stop(self) -> None:
        """End the preview, if one runs."""
        if self._preview is not None:
            session, thread = self._preview
            session.stop()
            thread.join()
            self._preview = None

    async def _start(self, request: web.Request) -> web.StreamResponse:
        camera = self._clip.camera
        return _json(
            frames=len(self._clip),
            size=[camera.width, camera.height],
            stamps=self._clip.stamp_s.tolist(),
            notes=list(self._clip.notes),
            out=str(self._out),
            queries=[_to_json(query) for query in self._queries],
        )

    def _t(self, request: web.Request) -> int:
        return min(int(request.match_info["t"]), len(self._clip) - 1)

    async def _frame(self, request: web.Request) -> web.StreamResponse:
        from aiohttp import web

        return web.Response(body=to_jpeg(self._clip.rgb[self._t(request)]), content_type="image/jpeg")

    async def _found(self, request: web.Request) -> web.StreamResponse:
        found = await asyncio.to_thread(self._tracker.find, self._clip.rgb[self._t(request)])
        least = self._tracker.config.prompt_threshold
        uv_px, box_px, p = found.uv_px.tolist(), found.box_px.tolist(), found.p.tolist()
        rows = [i for i, label in enumerate(found.labels) if label in LABELS and p[i] > least]
        return _json(
            found=[{"uv_px": uv_px[i], "box_px": box_px[i], "label": found.labels[i], "p": p[i]} for i in rows]
        )

    async def _read(self, request: web.Request) -> list[Query]:
        """The queries that a page sends.

        Raises:
            InputError: they are not as expected, or not of this recording.
        """
        picked = read_message(Picked, await request.text())
        for query in picked.queries:
            if query.frame >= len(self._clip):
                raise InputError(f"query {query.name!r}: frame {query.frame} of {len(self._clip)}")
        self._tracker.stream(self._clip.camera, picked.queries)  # refuses what cannot be asked together
        return list(picked.queries)

    async def _save(self, request: web.Request) -> web.StreamResponse:
        try:
            queries = await self._read(request)
            write_queries(queries, self._out)
        except (QuestError, OSError) as error:
            return _json(error=str(error))
        self._queries, self.saved = queries, len(queries)
        return _json(done=f"saved {self._out}")

    async def _finish(self, request: web.Request) -> web.StreamResponse:
        self.done.set()
        return _json(done="closed")

    async def _end_preview(self, request: web.Request) -> web.StreamResponse:
        await asyncio.to_thread(self.stop)
        return _json(done="stopped")

    async def _begin_preview(self, request: web.Request) -> web.StreamResponse:
        await asyncio.to_thread(self.stop)
        try:
            queries = await self._read(request)
            if not queries:
                raise InputError("nothing is picked yet; click into the picture")
            first = min(query.frame for query in queries)
            shifted = [replace(query, frame=query.frame - first) for query in queries]
            session = Session(self._tracker, _from(self._clip, first), shifted, wait=True)
        except QuestError as error:
            return _json(error=str(error))
        self._feed.begin(session)

        def run() -> None:
            words = "the end of the recording"
            try:
                for _ in session.run():
                    pass
            except Exception as error:  # of the program: the page says so and goes on, and the log has it whole
                _LOG.exception("the preview failed")
                words = str(error)
            self._feed.end(words)

        thread = threading.Thread(target=run, name="preview", daemon=True)
        self._preview = session, thread
        thread.start()
        return _json(first=first)


def _from(clip: Clip, first: int) -> FrameSource:
    """A clip from a frame on."""
    return replace(
        source_of_clip(clip), frames=lambda: (clip.frame(t) for t in range(first, len(clip))), length=len(clip) - first
    )


def _to_json(query: Query) -> dict[str, Any]:
    return {key: value for key, value in vars(query).items() if value not in (None, "")}


def _json(**fields: Any) -> web.Response:
    from aiohttp import web

    return web.json_response(fields)
