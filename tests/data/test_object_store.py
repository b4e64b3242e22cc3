"""Takes in an object store: the same as in a folder, with a header that is put last instead of a rename."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from quest.data.store import StoreError, TakeStore, _Bucket, locate_take, open_clip
from quest.errors import ConfigError, TakeError
from quest.types import Take
from tests.data.test_store import assert_equal
from tests.s3_server import s3_store
from tests.synthetic import make_take

obstore = pytest.importorskip("obstore")


@pytest.fixture(scope="module")
def take() -> Take:
    return make_take(frames=62, views=1, entities=2, size=(16, 8), name="panels")


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    with s3_store("bucket") as url:
        yield url


@pytest.fixture
def memory(request: pytest.FixtureRequest) -> TakeStore:
    """An empty prefix for each test."""
    return TakeStore(f"memory://tests/{request.node.name.replace('[', '-').replace(']', '')}/takes")


@pytest.fixture(params=["memory", "s3"])
def url(request: pytest.FixtureRequest) -> str:
    inside = request.node.name.replace("[", "-").replace("]", "")
    return f"memory://both/{inside}" if request.param == "memory" else f"{request.getfixturevalue('server')}/{inside}"


def place_of(store: TakeStore) -> _Bucket:
    assert isinstance(store._place, _Bucket)
    return store._place


def objects(store: TakeStore) -> dict[str, int]:
    """Size of everything that lies under the take, by path relative to it."""
    return place_of(store).sizes("panels")


def key(store: TakeStore, path: str) -> tuple[Any, str]:
    return place_of(store)._store, place_of(store)._key("panels", path)


def assert_whole(store: TakeStore, expected: Take) -> None:
    """The take can be read, and nothing else lies beside its files."""
    store.verify("panels")
    assert_equal(store.read("panels"), expected)
    assert objects(store).keys() == {*store.header("panels").files, "zarr.json"}


def test_read_returns_what_was_written(url: str, take: Take, tmp_path: Path) -> None:
    store = TakeStore(url)
    assert (store.exists(), store.names()) == (False, [])
    with pytest.raises(TakeError, match="check the name"):
        store.read("panels")
    with pytest.raises(TakeError, match="this is an object store"):
        store.path("panels")
    store.write(take)
    again = TakeStore(url + "/")
    assert_whole(again, take)
    assert (again.exists(), again.names(), "panels" in again, again.problems()) == (True, ["panels"], True, {})
    assert again.infos() == {"panels": take.info}
    assert list(again.headers(["panels", "others"])) == ["panels"]
    clip = open_clip(f"{url}/panels.zarr", frames=slice(58, 62))
    np.testing.assert_array_equal(clip.rgb, take.views[0].clip.rgb[58:62])
    before = objects(store)
    with pytest.raises(TakeError, match="written once"):
        store.write(take)
    assert objects(store) == before
    # A copy on disk reads alike, and has the digest of a take that was written into a folder.
    for path in before:
        file = tmp_path / "copied" / "panels.zarr" / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(bytes(obstore.get(*key(store, path)).bytes()))
    near = TakeStore(tmp_path / "near")
    near.write(take)
    assert_equal(TakeStore(tmp_path / "copied").read("panels"), take)
    assert store.data_hash("panels") == near.data_hash("panels")
    small = make_take(frames=2, views=1, entities=1, size=(8, 8))
    for name in ("a", "b"):
        store.write(replace(small, info=replace(small.info, name=name)))
    assert store.names() == list(store.headers()) == ["a", "b", "panels"]


def test_a_writer_that_was_killed_leaves_no_take_and_is_in_nobodys_way(url: str, take: Take) -> None:
    store = TakeStore(url)
    store.write(take)
    obstore.delete(*key(store, "zarr.json"))  # all but the last step
    left = objects(store)
    assert left
    assert (store.names(), "panels" in store) == ([], False)
    assert "holds no zarr.json" in store.problems()["panels"]
    store.write(take)
    assert_whole(store, take)
    assert store.problems() == {}
    assert not left.keys() & objects(store).keys()


def test_of_two_writers_the_first_one_counts(url: str, take: Take, monkeypatch: pytest.MonkeyPatch) -> None:
    takes = {"take": take, "other": replace(take, point_world=take.point_world + 1)}
    meeting, outcomes, commit = threading.Barrier(2, timeout=60), {}, _Bucket.commit

    def meet_and_commit(self: _Bucket, name: str, writer: str, header: bytes) -> None:
        meeting.wait()  # both have put everything but their headers
        commit(self, name, writer, header)

    def write(which: str) -> None:
        try:
            TakeStore(url).write(takes[which])
            outcomes[which] = ""
        except TakeError as error:
            outcomes[which] = str(error)

    monkeypatch.setattr(_Bucket, "commit", meet_and_commit)
    writers = [threading.Thread(target=write, args=(which,)) for which in takes]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    won, lost = sorted(outcomes, key=lambda which: outcomes[which])
    assert outcomes[won] == ""
    assert "was written by another process meanwhile" in outcomes[lost]
    assert_whole(TakeStore(url), takes[won])


def no_route(*_: Any) -> None:
    raise obstore.exceptions.GenericError("no route to host")


def ctrl_c(*_: Any) -> None:
    raise KeyboardInterrupt


def test_a_failing_write_leaves_nothing(memory: TakeStore, take: Take, monkeypatch: pytest.MonkeyPatch) -> None:
    put = obstore.put
    with monkeypatch.context() as patched:
        patched.setattr(obstore, "put", lambda *args, **how: no_route() if "rgb/c" in args[1] else put(*args, **how))
        with pytest.raises(StoreError, match="no route to host"):
            memory.write(take)
    assert objects(memory) == {}
    with monkeypatch.context() as patched:  # the header did not arrive: what is left is in nobody's way
        patched.setattr(obstore, "put", lambda *args, **options: no_route() if options else put(*args))
        with pytest.raises(StoreError, match="no route to host"):
            memory.write(take)
    assert "panels" not in memory
    memory.write(take)
    assert_whole(memory, take)


@pytest.mark.parametrize("error", [no_route, ctrl_c])
def test_what_a_header_may_name_is_kept(
    memory: TakeStore, take: Take, error: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The header arrived, and its writer does not know."""
    put = obstore.put

    def put_and_fail(place: Any, path: str, data: Any, **options: Any) -> None:
        put(place, path, data, **options)
        if options:
            error()

    with monkeypatch.context() as patched:
        patched.setattr(obstore, "put", put_and_fail)
        with pytest.raises((StoreError, KeyboardInterrupt)):
            memory.write(take)
    assert_whole(memory, take)


def test_a_lost_answer_to_the_last_step_is_no_failure(
    memory: TakeStore, take: Take, monkeypatch: pytest.MonkeyPatch
) -> None:
    put = obstore.put

    def put_twice(place: Any, path: str, data: Any, **options: Any) -> Any:
        if options.get("mode") == "create":
            put(place, path, data, **options)
        return put(place, path, data, **options)

    monkeypatch.setattr(obstore, "put", put_twice)
    monkeypatch.setattr(_Bucket, "_remove", ctrl_c)
    with pytest.raises(KeyboardInterrupt):  # and what is interrupted afterwards does no harm
        memory.write(take)
    assert_whole(memory, take)


def test_a_store_that_cannot_compare(memory: TakeStore, take: Take, monkeypatch: pytest.MonkeyPatch) -> None:
    put = obstore.put

    def put_anyway(place: Any, path: str, data: Any, **options: Any) -> Any:
        if options:
            raise obstore.exceptions.NotSupportedError("no conditions")
        return put(place, path, data)

    monkeypatch.setattr(obstore, "put", put_anyway)
    memory.write(take)
    assert_whole(memory, take)
    with pytest.raises(TakeError, match="written once"):
        memory.write(take)


def test_torn_takes_and_flipped_bits_are_noticed(memory: TakeStore, take: Take) -> None:
    memory.write(take)
    path = next(path for path in memory.header("panels").files if path.endswith("view_0/rgb/c/1/0/0/0"))
    place, where = key(memory, path)
    whole = bytes(obstore.get(place, where).bytes())
    flipped = bytearray(whole)
    flipped[len(whole) // 3] ^= 0xFF
    obstore.put(place, where, bytes(flipped))
    with pytest.raises(TakeError, match="an array: cannot be read"):
        memory.read("panels")
    for tear in (lambda: obstore.put(place, where, b"short"), lambda: obstore.delete(place, where)):
        tear()
        with pytest.raises(TakeError, match=r"torn.*view_0/rgb/c/1/0/0/0"):
            memory.read("panels")
        assert memory.names() == []
        assert "torn" in memory.problems()["panels"]


def test_a_bucket_that_is_not_there(server: str) -> None:
    store = TakeStore("s3://another/takes")
    for use in (store.names, store.exists, lambda: "panels" in store, lambda: store.read("panels")):
        with pytest.raises(StoreError, match=r"s3://another/takes: cannot be reached.*NoSuchBucket"):
            use()


@pytest.mark.parametrize(
    ("root", "message"),
    [
        ("ftp://somewhere/takes", "expected a folder, file://PATH or s3, gs"),
        (Path("s3://bucket/takes"), "two slashes"),
        ("s3:///takes", "BUCKET/PREFIX"),
        ("az://container/takes", "Account must be specified"),
    ],
)
def test_urls_that_cannot_be_used(root: str | Path, message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("AZURE_STORAGE_ACCOUNT_NAME", "AZURE_STORAGE_CONNECTION_STRING"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(ConfigError, match=message):
        TakeStore(root)


def test_places_of_takes(tmp_path: Path) -> None:
    assert TakeStore(tmp_path.as_uri() + "/some%20takes").root == tmp_path / "some takes"
    assert locate_take(tmp_path / "panels.zarr")[0].root == tmp_path
    store, name = locate_take("panels.zarr")
    assert (store.root, name) == (Path(), "panels")
    store, name = locate_take("memory://tests/a/panels.zarr/")
    assert (store.url, name) == ("memory://tests/a", "panels")
    with pytest.raises(TakeError, match="expected a folder"):
        locate_take("memory://tests/a")
