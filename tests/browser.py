"""A headless Chromium that a test drives: it opens a page, clicks, types, and tells what the console said."""

from __future__ import annotations

import asyncio
import itertools
import shutil
import subprocess
import tempfile
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "google-chrome", "chromium-browser"))), None)
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
_START_S = 30.0
_PATIENCE_S = 30.0
_STEADY_BOX = """new Promise(done => {
  const box = () => (b => [b.left, b.top, b.width, b.height])(document.querySelector(%s).getBoundingClientRect());
  const look = last => requestAnimationFrame(() => String(box()) === String(last) ? done(last) : look(box()));
  look(box());
})"""  # where an element is once the layout stands still: a click elsewhere is lost


class Page:
    """One page of the browser, by the DevTools protocol."""

    def __init__(self, socket: Any) -> None:
        self._socket = socket
        self._number = itertools.count(1)
        self.errors: list[str] = []

    async def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """One command; what the console says meanwhile is kept if it is an error."""
        number = next(self._number)
        await self._socket.send_json({"id": number, "method": method, "params": parameters})
        while True:
            said = await self._socket.receive_json(timeout=_PATIENCE_S)
            what = said.get("method")
            if what == "Runtime.exceptionThrown":
                self.errors.append(str(said["params"]["exceptionDetails"]))
            elif what == "Log.entryAdded" and said["params"]["entry"]["level"] == "error":
                self.errors.append(said["params"]["entry"]["text"])
            elif what == "Runtime.consoleAPICalled" and said["params"]["type"] == "error":
                self.errors.append(str(said["params"]["args"]))
            elif said.get("id") == number:
                assert "error" not in said, said
                return said["result"]

    async def run(self, script: str) -> Any:
        """The value of a script, which may be a promise."""
        told = await self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in told, told
        return told["result"].get("value")

    async def until(self, script: str) -> Any:
        """Wait until a script gives something true."""
        ends_s = time.monotonic() + _PATIENCE_S
        while not (value := await self.run(script)):
            if time.monotonic() > ends_s:
                pytest.fail(f"in vain: {script}; console: {self.errors}; {await self.run('document.body.innerText')}")
            await asyncio.sleep(0.05)
        return value

    async def click(
        self, selector: str, x: float = 0.5, y: float = 0.5, *, to: tuple[float, float] | None = None
    ) -> None:
        """Click at a share of an element's width and height, or drag from there to another."""
        box = await self.run(_STEADY_BOX % repr(selector))
        ends = [(box[0] + u * box[2], box[1] + v * box[3]) for u, v in ((x, y), to or (x, y))]
        steps = [("mousePressed", ends[0]), ("mouseMoved", ends[1]), ("mouseReleased", ends[1])]
        for kind, (px, py) in steps:
            await self.call("Input.dispatchMouseEvent", type=kind, x=px, y=py, button="left", clickCount=1, buttons=1)

    async def key(self, name: str) -> None:
        """Press a key."""
        for kind in ("keyDown", "keyUp"):
            await self.call("Input.dispatchKeyEvent", type=kind, key=name, code=name)


def browse(url: str, script: Callable[[Page], Awaitable[None]], *, width: int = 1280) -> list[str]:
    """Open a page, go through a script, and give the errors of its console."""
    assert CHROMIUM is not None
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        flags = ["--headless", "--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader"]
        flags += ["--remote-debugging-port=0", f"--user-data-dir={profile}", "about:blank"]
        with subprocess.Popen([CHROMIUM, *flags], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
            try:
                return asyncio.run(_browse(Path(profile) / "DevToolsActivePort", url, script, width))
            finally:
                process.terminate()


async def _browse(port_file: Path, url: str, script: Callable[[Page], Awaitable[None]], width: int) -> list[str]:
    import aiohttp

    ends_s = time.monotonic() + _START_S
    while not (port_file.exists() and port_file.read_text().strip()):
        assert time.monotonic() < ends_s, "Chromium does not start"
        await asyncio.sleep(0.05)
    port = port_file.read_text().splitlines()[0]
    async with aiohttp.ClientSession() as session:
        async with session.get(f"http://127.0.0.1:{port}/json") as answer:
            target = next(each for each in await answer.json() if each["type"] == "page")
        async with session.ws_connect(target["webSocketDebuggerUrl"], max_msg_size=0) as socket:
            page = Page(socket)
            for domain in ("Runtime", "Log", "Page"):
                await page.call(f"{domain}.enable")
            screen = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
            await page.call("Emulation.setDeviceMetricsOverride", **screen)
            await page.call("Page.navigate", url=url)
            await page.until("document.readyState === 'complete'")
            await script(page)
            return page.errors
