"""The pages of quest live and quest pick in a browser, and who may not use them."""

from __future__ import annotations

import json
import threading
import urllib.error
import urllib.request
from pathlib import Path

import pytest

from quest.data.cut import cut_clip
from quest.data.frame_source import source_of_clip
from quest.data.live_camera import as_live
from quest.data.queries_file import read_queries
from quest.data.recording import read_recording
from quest.errors import InputError
from quest.live.picking import Picking
from quest.live.server import Feed, Server, read_message
from quest.live.session import Edit, Session
from quest.types import Clip, Query
from tests.browser import Page, browse, needs_browser
from tests.track.clips import make_calibration, make_tracker


@pytest.fixture(scope="module")
def clip() -> Clip:
    return cut_clip(read_recording("sample-alarm"), slice(0, 12))


def fetch(url: str, body: dict | None = None, **headers: str) -> tuple[int, str]:
    data = None if body is None else json.dumps(body).encode()
    try:
        with urllib.request.urlopen(urllib.request.Request(url, data, headers)) as answer:
            return answer.status, answer.read().decode("utf-8", "replace")
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()


def test_only_this_page_is_answered():
    with Server('a "title" <b>', "live", {"GET /feed": Feed().serve}) as server:
        status, text = fetch(server.url)
        assert status == 200
        assert "a &quot;title&quot; &lt;b&gt;" in text
        port = server.url.split(":")[2].partition("/")[0]
        assert fetch(server.url + "page.js")[0] == 200
        assert fetch(f"http://127.0.0.1:{port}/")[0] == 404
        assert fetch(f"http://127.0.0.1:{port}/guess/")[0] == 404
        assert fetch(server.url, Host="evil.example")[0] == 403
        assert fetch(server.url, Origin="http://evil.example")[0] == 403
        assert fetch(server.url + "page.css/../../session.py")[0] == 404
        with pytest.raises(InputError, match=f"--port {port}"), Server("other", "live", {}, port=int(port)):
            pass


def test_messages_are_checked():
    assert read_message(Edit, '{"do": "retire", "query": 3}') == Edit("retire", query=3)
    for text in (
        "",
        "[]",
        '{"do": "run"}',
        '{"do": "retire", "query": "3"}',
        '{"do": "pause", "more": 1}',
        '{"x": NaN}',
    ):
        with pytest.raises(InputError, match="page"):
            read_message(Edit, text)


def test_what_is_saved_is_checked(clip: Clip, tmp_path: Path):
    picking = Picking(make_tracker(), clip, [], tmp_path / "queries.json")
    wrong = [
        [{"kind": "point"}], [{"kind": "point", "frame": 99, "uv_px": [1, 1]}], [{"kind": "wheel"}],
        [{"kind": "point", "uv_px": [9999, 1]}], [{"kind": "slot", "name": "a"}] * 2, "no",
    ]  # fmt: skip
    with Server("pick", "pick", picking.routes) as server:
        for queries in wrong:
            assert "error" in json.loads(fetch(server.url + "save", {"queries": queries})[1]), queries
        assert not (tmp_path / "queries.json").exists()
        assert "error" in json.loads(fetch(server.url + "preview", {"queries": []})[1])


@needs_browser
@pytest.mark.slow
def test_live_in_a_browser(clip: Clip):
    tracker = make_tracker()
    tracker.calibrations = {"depth": make_calibration(alarming=True)}
    assert clip.depth_m is not None
    still = Clip.from_arrays(clip.rgb[:1].repeat(400, 0), clip.depth_m[:1].repeat(400, 0), clip.camera, fps=20)
    name = '<img src=x onerror="throw 1">'
    session = Session(tracker, as_live(source_of_clip(still)), [Query.point(0, 100, 100, name=name)], alpha=0.2)
    feed = Feed()
    feed.begin(session)

    def run() -> None:
        for _ in session.run():
            pass
        feed.end("over")

    async def script(page: Page) -> None:
        await page.until("document.querySelector('.card.alarm') !== null")
        assert await page.run("document.querySelector('.card input').value") == name
        assert "Alarm" in await page.run("document.querySelector('.card .why').innerText")
        await page.click("#view", 0.5, 0.4)
        await page.until("cards.size === 2")
        u, v = await page.until("(one => one && one.uv_px)(answers.find(one => one.query === 1))")
        assert abs(u / still.camera.width - 0.5) < 0.02
        assert abs(v / still.camera.height - 0.4) < 0.02
        await page.run("document.querySelectorAll('.card .bar button')[1].click()")
        assert await page.run("!document.querySelector('#hint').hidden")
        await page.click("#view", 0.25, 0.25)
        await page.until("Math.abs(answers.find(one => one.query === 0).uv_px[0] / size[0] - .25) < .02")
        await page.run("document.querySelectorAll('.card .row button')[1].click()")
        await page.until("cards.size === 1")
        await page.run(
            "(i => { i.value = 'lid'; i.dispatchEvent(new Event('change')); })(document.querySelector('.card input'))"
        )
        await page.until("answers[0].name === 'lid'")
        await page.run("document.querySelector('#view').focus()")
        await page.key("ArrowRight")
        await page.key("Enter")
        await page.until("cards.size === 2")
        session.stop()
        await page.until("document.querySelector('#status').innerText === 'over'")

    with Server("live", "live", {"GET /feed": feed.serve}) as server:
        thread = threading.Thread(target=run)
        thread.start()
        try:
            assert browse(server.url, script) == []
        finally:
            session.stop()
            thread.join()


@needs_browser
@pytest.mark.slow
def test_pick_in_a_browser(clip: Clip, tmp_path: Path):
    out = tmp_path / "queries.json"
    picking = Picking(make_tracker(), clip, [Query.semantic("handle", name="mine")], out)

    async def script(page: Page) -> None:
        await page.until("picture !== null && cards.size === 1")
        await page.click("#view", 0.5, 0.5)
        await page.click("#view", 0.2, 0.2, to=(0.4, 0.3))
        await page.run("$('slider').value = 5; $('slider').dispatchEvent(new Event('input'))")
        await page.until("shown === 5")
        await page.run("$('name').value = 'late'; $('label').value = 'knob'")
        await page.click("#view", 0.75, 0.25)
        await page.run("document.querySelector('.card button').click()")
        await page.click("#preview")
        await page.until("answers.length > 1")
        await page.until("socket === null")
        assert await page.run("document.querySelector('#status').innerText") == "the end of the recording"
        await page.click("#save")
        await page.until("document.querySelector('#events').innerText.includes('saved')")
        await page.click("#done")
        await page.until("document.querySelector('#status').innerText.includes('closed')")

    with Server("pick", "pick", picking.routes) as server:
        assert browse(server.url, script, width=380) == []
    picking.stop()
    assert picking.done.is_set()
    queries = read_queries(out)
    width, height = clip.camera.width, clip.camera.height
    assert [(q.kind, q.frame, q.name, q.label) for q in queries] == [
        ("point", 0, "", None), ("point", 0, "", None), ("point", 5, "late", "knob"),
    ]  # fmt: skip
    for query, at in zip(queries, ((0.5, 0.5), (0.3, 0.25), (0.75, 0.25)), strict=True):
        assert query.uv_px == pytest.approx((at[0] * width, at[1] * height), abs=3)
