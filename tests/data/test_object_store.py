"""Takes in an object store: the same as in a folder, with a header that is put last instead of a rename."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from quest.data.store import TakeStore, locate_take, open_clip
from quest.data.store_location import ObjectPrefix, StoreError
from quest.errors import ConfigError, TakeError
from quest.types import Take
from tests.data.test_store import assert_equal
from tests.s3_server import s3_store
from tests.synthetic import make_take

obstore = pytest.importorskip("obstore")


@pytest.fixture(scope="module")
def take() -> Take:
    return make_take(frames=70, views=2, entities=2, size=(24, 16), name="panels")


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    with s3_store("bucket") as url:
        yield url


@pytest.fixture(params=["memory", "s3"])
def url(request: pytest.FixtureRequest) -> str:
    """An empty prefix for each test."""
    inside = request.node.name.replace("[", "-").replace("]", "")
    if request.param == "memory":
        return f"memory://tests/{inside}/takes"
    return f"{request.getfixturevalue('server')}/{inside}"


def objects(store: TakeStore, name: str) -> dict[str, int]:
    """Size of everything that lies under a take, by path relative to it."""
    place = store._location
    assert isinstance(place, ObjectPrefix)
    return place.sizes(name, {})


def key(store: TakeStore, name: str, path: str) -> tuple[Any, str]:
    place = store._location
    assert isinstance(place, ObjectPrefix)
    return place._store, place._key(name, path)


def test_read_returns_what_was_written(url: str, take: Take) -> None:
    store = TakeStore(url)
    assert not store.exists()
    assert store.names() == []
    store.write(take)
    again = TakeStore(url + "/")
    assert_equal(again.read("panels"), take)
    again.verify("panels")
    assert again.exists()
    assert again.names() == ["panels"]
    assert again.infos() == {"panels": take.info}
    assert list(again.headers(["panels", "others"])) == ["panels"]
    assert "panels" in again
    assert again.problems() == {}
    np.testing.assert_array_equal(
        open_clip(f"{url}/panels.zarr", view=1, frames=slice(58, 63)).rgb, take.views[1].clip.rgb[58:63]
    )


def test_the_digest_is_that_of_a_folder(url: str, take: Take, tmp_path: Path) -> None:
    far, near = TakeStore(url), TakeStore(tmp_path)
    far.write(take)
    near.write(take)
    assert far.data_hash("panels") == near.data_hash("panels")


def test_a_copy_on_disk_reads_like_the_original(take: Take, tmp_path: Path) -> None:
    store = TakeStore("memory://copied/takes")
    store.write(take)
    for path in objects(store, "panels"):
        file = tmp_path / "panels.zarr" / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(bytes(obstore.get(*key(store, "panels", path)).bytes()))
    assert_equal(TakeStore(tmp_path).read("panels"), take)


def test_a_name_is_written_once(url: str, take: Take) -> None:
    store = TakeStore(url)
    store.write(take)
    before = objects(store, "panels")
    with pytest.raises(TakeError, match="written once"):
        store.write(take)
    assert objects(store, "panels") == before


def test_takes_that_are_not_there(url: str) -> None:
    with pytest.raises(TakeError, match="check the name"):
        TakeStore(url).read("panels")
    with pytest.raises(TakeError, match="this is an object store"):
        TakeStore(url).path("panels")


def test_a_writer_that_was_killed_leaves_no_take_and_is_in_nobodys_way(url: str, take: Take) -> None:
    store = TakeStore(url)
    store.write(take)
    obstore.delete(*key(store, "panels", "zarr.json"))  # all but the last step
    left = objects(store, "panels")
    assert left
    assert store.names() == []
    assert "panels" not in store
    assert "holds no zarr.json" in store.problems()["panels"]
    store.write(take)
    store.verify("panels")
    assert store.problems() == {}
    assert not left.keys() & objects(store, "panels").keys()
    assert objects(store, "panels").keys() == {*store.header("panels").files, "zarr.json"}


def test_a_failing_write_leaves_nothing(url: str, take: Take, monkeypatch: pytest.MonkeyPatch) -> None:
    def unplugged(self: ObjectPrefix, name: str, writer: str, header: bytes) -> None:
        raise obstore.exceptions.GenericError("no route to host")

    monkeypatch.setattr(ObjectPrefix, "commit", unplugged)
    store = TakeStore(url)
    with pytest.raises(StoreError, match="no route to host"):
        store.write(take)
    assert objects(store, "panels") == {}


def test_of_two_writers_the_first_one_counts(url: str, take: Take, monkeypatch: pytest.MonkeyPatch) -> None:
    other = replace(take, point_world=take.point_world + 1)
    meeting, outcomes = threading.Barrier(2, timeout=30), {}
    commit = ObjectPrefix.commit

    def meet_and_commit(self: ObjectPrefix, name: str, writer: str, header: bytes) -> None:
        meeting.wait()  # both have put everything but their headers
        commit(self, name, writer, header)

    def write(which: str, written: Take) -> None:
        try:
            TakeStore(url).write(written)
            outcomes[which] = ""
        except TakeError as error:
            outcomes[which] = str(error)

    monkeypatch.setattr(ObjectPrefix, "commit", meet_and_commit)
    writers = [threading.Thread(target=write, args=pair) for pair in (("take", take), ("other", other))]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    store = TakeStore(url)
    won, lost = sorted(outcomes, key=lambda which: outcomes[which])
    assert outcomes[won] == ""
    assert "was written by another process meanwhile" in outcomes[lost]
    store.verify("panels")
    assert_equal(store.read("panels"), {"take": take, "other": other}[won])
    assert objects(store, "panels").keys() == {*store.header("panels").files, "zarr.json"}


def test_a_lost_answer_to_the_last_step_is_no_failure(take: Take, monkeypatch: pytest.MonkeyPatch) -> None:
    store = TakeStore("memory://lost/answers")
    put = obstore.put

    def put_twice(place: Any, path: str, data: Any, **options: Any) -> Any:
        if options.get("mode") == "create":
            put(place, path, data, **options)
        return put(place, path, data, **options)

    monkeypatch.setattr(obstore, "put", put_twice)
    store.write(take)
    store.verify("panels")


def lost_answer(*_: Any) -> None:
    raise obstore.exceptions.GenericError("no route to host")


def ctrl_c(*_: Any) -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize("error", [lost_answer, ctrl_c])
def test_what_a_header_may_name_is_kept(take: Take, error: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The header arrived, and its writer does not know."""
    store = TakeStore(f"memory://kept/{error.__name__}")
    put = obstore.put

    def put_and_fail(place: Any, path: str, data: Any, **options: Any) -> None:
        put(place, path, data, **options)
        if options:
            error()

    with monkeypatch.context() as patched:
        patched.setattr(obstore, "put", put_and_fail)
        with pytest.raises((StoreError, KeyboardInterrupt)):
            store.write(take)
    store.verify("panels")
    assert_equal(store.read("panels"), take)


def test_a_take_survives_what_is_interrupted_after_it(take: Take, monkeypatch: pytest.MonkeyPatch) -> None:
    store = TakeStore("memory://interrupted/takes")
    with monkeypatch.context() as patched:
        patched.setattr(ObjectPrefix, "_remove", ctrl_c)
        with pytest.raises(KeyboardInterrupt):
            store.write(take)
    store.verify("panels")


def test_a_header_that_did_not_arrive_leaves_rubbish_in_nobodys_way(
    take: Take, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = TakeStore("memory://rubbish/takes")
    put = obstore.put
    with monkeypatch.context() as patched:
        patched.setattr(obstore, "put", lambda *args, **options: lost_answer() if options else put(*args))
        with pytest.raises(StoreError, match="no route to host"):
            store.write(take)
    assert "panels" not in store
    left = objects(store, "panels")
    store.write(take)
    store.verify("panels")
    assert not left.keys() & objects(store, "panels").keys()


def test_the_second_of_two_writers_removes_its_files(take: Take, monkeypatch: pytest.MonkeyPatch) -> None:
    store, other = TakeStore("memory://second/takes"), replace(take, point_world=take.point_world + 1)
    commit = ObjectPrefix.commit

    def be_late(self: ObjectPrefix, name: str, writer: str, header: bytes) -> None:
        with monkeypatch.context() as patched:
            patched.setattr(ObjectPrefix, "commit", commit)
            TakeStore("memory://second/takes").write(other)
        commit(self, name, writer, header)

    monkeypatch.setattr(ObjectPrefix, "commit", be_late)
    with pytest.raises(TakeError, match="written by another process meanwhile"):
        store.write(take)
    assert_equal(store.read("panels"), other)
    assert objects(store, "panels").keys() == {*store.header("panels").files, "zarr.json"}


def test_a_store_that_cannot_compare(take: Take, monkeypatch: pytest.MonkeyPatch) -> None:
    store = TakeStore("memory://cannot/compare")
    put = obstore.put

    def put_anyway(place: Any, path: str, data: Any, **options: Any) -> Any:
        if options:
            raise obstore.exceptions.NotSupportedError("no conditions")
        return put(place, path, data)

    monkeypatch.setattr(obstore, "put", put_anyway)
    store.write(take)
    store.verify("panels")
    with pytest.raises(TakeError, match="written once"):
        store.write(take)


@pytest.mark.parametrize("how", ["missing", "short"])
def test_torn_takes_are_noticed(url: str, take: Take, how: str) -> None:
    store = TakeStore(url)
    store.write(take)
    path = next(path for path in store.header("panels").files if path.endswith("view_0/rgb/c/1/0/0/0"))
    obstore.delete(*key(store, "panels", path))
    if how == "short":
        obstore.put(*key(store, "panels", path), b"short")
    with pytest.raises(TakeError, match=r"torn.*view_0/rgb/c/1/0/0/0"):
        store.read("panels")
    assert store.names() == []
    assert "torn" in store.problems()["panels"]


def test_flipped_bits_are_noticed(url: str, take: Take) -> None:
    store = TakeStore(url)
    store.write(take)
    place, path = key(store, "panels", max(objects(store, "panels"), key=objects(store, "panels").__getitem__))
    data = bytearray(bytes(obstore.get(place, path).bytes()))
    data[len(data) // 3] ^= 0xFF
    obstore.put(place, path, bytes(data))
    with pytest.raises(TakeError, match="an array: cannot be read"):
        store.read("panels")


def test_many_takes(url: str) -> None:
    store = TakeStore(url)
    small = make_take(frames=2, views=1, entities=1, size=(8, 8))
    names = [f"take-{n:02d}" for n in range(8)]
    for name in names:
        store.write(replace(small, info=replace(small.info, name=name)))
    assert store.names() == names
    assert list(store.headers()) == names


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


def test_a_file_url_is_a_folder(tmp_path: Path, take: Take) -> None:
    store = TakeStore(tmp_path.as_uri() + "/some%20takes")
    store.write(take)
    assert (tmp_path / "some takes" / "panels.zarr").is_dir()


def test_locating_takes(tmp_path: Path) -> None:
    assert locate_take(tmp_path / "panels.zarr")[0].root == tmp_path
    store, name = locate_take("panels.zarr")
    assert (store.root, name) == (Path(), "panels")
    store, name = locate_take("memory://tests/a/panels.zarr/")
    assert (store.url, name) == ("memory://tests/a", "panels")
    with pytest.raises(TakeError, match="expected a folder"):
        locate_take("memory://tests/a")
