"""Serves a page to this machine alone: a WebSocket for what is live, a few files, and a secret in every address."""

from __future__ import annotations

import asyncio
import html
import json
import logging
import secrets
import threading
from collections.abc import Awaitable, Callable, Mapping
from importlib.resources import files
from typing import TYPE_CHECKING, Literal, TypeVar

from quest.errors import InputError, QuestError
from quest.extras import require
from quest.live.session import Edit, Session, Shot
from quest.types import LABELS
from quest.untrusted import build, parse_json

if TYPE_CHECKING:
    from aiohttp import web

HOST = "127.0.0.1"
_T = TypeVar("_T")
_START_S = 10.0
_TYPES = {"html": "text/html", "js": "text/javascript", "css": "text/css"}
_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
_MOST_BYTES = 1 << 20
"""Of a message from a page."""


class Feed:
    """What open pages are shown: each gets the newest shot when it is ready for one, so that none falls behind."""

    def __init__(self) -> None:
        self.session: Session | None = None
        self.newest: Shot | None = None
        self.ended: str | None = None
        self.opened = threading.Event()
        self._changed: set[asyncio.Event] = set()
        self._loop: asyncio.AbstractEventLoop | None = None

    def begin(self, session: Session) -> None:
        """Show a session from now on."""
        self.session, self.newest, self.ended = session, None, None
        session.on_shot(self._show)

    def end(self, words: str) -> None:
        """Say to all pages that it is over, and why."""
        self.ended = words
        self._wake()

    def _show(self, shot: Shot) -> None:
        self.newest = shot
        self._wake()

    def _wake(self) -> None:
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(lambda: [changed.set() for changed in self._changed])

    async def serve(self, request: web.Request) -> web.StreamResponse:
        """One page: shots out, one at a time; edits in."""
        from aiohttp import WSMsgType, web

        self._loop = asyncio.get_running_loop()
        socket = web.WebSocketResponse(max_msg_size=_MOST_BYTES, heartbeat=20)
        await socket.prepare(request)
        changed, ready = asyncio.Event(), asyncio.Event()
        changed.set()
        ready.set()
        self._changed.add(changed)
        self.opened.set()
        sender = asyncio.create_task(self._send(socket, changed, ready))
        try:
            async for message in socket:
                if message.type is not WSMsgType.TEXT:
                    break
                if message.data == "ready":
                    ready.set()
                else:
                    await socket.send_str(json.dumps(await self._edit(message.data)))
        finally:
            self._changed.discard(changed)
            sender.cancel()
        return socket

    async def _send(self, socket: web.WebSocketResponse, changed: asyncio.Event, ready: asyncio.Event) -> None:
        sent: Shot | None = None
        while not socket.closed:
            await changed.wait()
            await ready.wait()
            changed.clear()
            shot = self.newest
            if shot is not None and shot is not sent:
                sent = shot
                ready.clear()
                header = shot.header.encode()
                await socket.send_bytes(len(header).to_bytes(4, "little") + header + shot.jpeg)
            if self.ended is not None:
                await socket.send_str(json.dumps({"ended": self.ended}))
                return

    async def _edit(self, text: str) -> dict[str, str]:
        """Do what a page asks; what to say to it."""
        try:
            edit = read_message(Edit, text)
            if self.session is None or self.ended is not None:
                raise InputError("nothing is running")
            return {"done": await asyncio.wait_for(asyncio.wrap_future(self.session.ask(edit)), timeout=_START_S)}
        except QuestError as error:
            return {"error": str(error)}
        except TimeoutError:
            return {"error": "the camera sends no frames"}


def read_message(kind: type[_T], text: str) -> _T:
    """What a page sent, checked.

    Raises:
        InputError: it is no JSON, or not of the kind.
    """
    value = parse_json(text, "page", InputError, "load the page again")
    try:
        return build(kind, value)
    except (ValueError, TypeError) as error:
        raise InputError(f"page: {error}") from error


Handler = Callable[["web.Request"], Awaitable["web.StreamResponse"]]


class Server:
    """Serves one page on the loopback interface, in a thread of its own; a context manager.

    Every address has a secret in it, and requests for another host or from another page are refused: what runs in a
    browser, or as another user without that secret, can neither see nor change anything. Routes are handlers by
    ``METHOD /path`` under the secret; port 0 takes one that is free.

    Raises:
        MissingExtraError: the extra ``live`` is not installed.
        InputError: the port is taken.
    """

    def __init__(
        self, title: str, mode: Literal["live", "pick"], routes: Mapping[str, Handler], *, port: int = 0
    ) -> None:
        require("aiohttp")
        self._title, self._mode, self._routes, self._port = title, mode, routes, port
        self._secret = secrets.token_urlsafe(16)
        self._loop = asyncio.new_event_loop()
        self._started = threading.Event()
        self._failed: OSError | None = None
        self._thread = threading.Thread(target=self._run, name="page", daemon=True)

    @property
    def url(self) -> str:
        """The page's address."""
        return f"http://{HOST}:{self._port}/{self._secret}/"

    def __enter__(self) -> Server:
        self._thread.start()
        self._started.wait(_START_S)
        if self._failed is not None:
            raise InputError(f"--port {self._port}: cannot be served ({self._failed.strerror}); name another, or 0")
        return self

    def __exit__(self, *_: object) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(_START_S)

    def _run(self) -> None:
        from aiohttp import web

        logging.getLogger("aiohttp.access").setLevel(logging.WARNING)
        app = web.Application(client_max_size=_MOST_BYTES, middlewares=[self._guard()])
        for place, handler in self._routes.items():
            method, _, path = place.partition(" ")
            app.router.add_route(method, f"/{self._secret}{path}", handler)
        app.router.add_get(f"/{self._secret}/{{name:(page\\.(js|css))?}}", self._file)
        runner = web.AppRunner(app, access_log=None)
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(runner.setup())
            site = web.TCPSite(runner, HOST, self._port)
            self._loop.run_until_complete(site.start())
            self._port = runner.addresses[0][1]
        except OSError as error:
            self._failed = error
            return
        finally:
            self._started.set()
        try:
            self._loop.run_forever()
        finally:
            self._loop.run_until_complete(runner.cleanup())
            self._loop.close()

    def _guard(self) -> Callable[..., Awaitable[web.StreamResponse]]:
        from aiohttp import web

        @web.middleware
        async def guard(request: web.Request, handler: Handler) -> web.StreamResponse:
            here = {f"{HOST}:{self._port}", f"localhost:{self._port}"}
            origin = request.headers.get("Origin")
            if request.host not in here or (origin is not None and origin.removeprefix("http://") not in here):
                raise web.HTTPForbidden(text="another host")
            response = await handler(request)
            if not response.prepared:
                response.headers.update(_HEADERS)
            return response

        return guard

    async def _file(self, request: web.Request) -> web.StreamResponse:
        from aiohttp import web

        name = request.match_info["name"] or "page.html"
        text = files("quest.live").joinpath("page", name).read_text(encoding="utf-8")
        if name == "page.html":
            labels = "".join(f"<option>{label}</option>" for label in LABELS)
            for mark, value in (("TITLE", html.escape(self._title)), ("MODE", self._mode), ("LABELS", labels)):
                text = text.replace(f"%{mark}%", value)
        return web.Response(text=text, content_type=_TYPES[name.rpartition(".")[2]])
