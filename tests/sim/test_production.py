"""A production in one process: events, resuming, failures, and kill -9 at random moments."""

from __future__ import annotations

import multiprocessing
import os
import random
import signal
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from quest.data.store import TakeStore
from quest.errors import ConfigError, ObjectError, RendererError, TakeError
from quest.sim.cameras import CameraStyle
from quest.sim.objects import object_digest
from quest.sim.plan import TakeSpec
from quest.sim.production import (
    Event,
    Notice,
    Studio,
    TakeMade,
    TakeSkipped,
    missing_takes,
    produce,
    write_once,
)
from quest.sim.sensor import SENSORS
from quest.sim.settings import TakeSettings
from quest.types import Take
from tests.s3_server import s3_store
from tests.sim.small_objects import write_cabinet
from tests.sim.stub_studio import StubStudio, plan, produce_missing


@pytest.fixture
def store(tmp_path: Path) -> TakeStore:
    return TakeStore(tmp_path / "takes")


def hashes(store: TakeStore) -> dict[str, str]:
    return {name: header.data_hash for name, header in store.headers().items()}


def test_takes_are_reported_in_order_when_they_are_there(store: TakeStore) -> None:
    events: list[Event] = []

    def report(event: Event) -> None:
        assert not isinstance(event, TakeMade) or event.spec.name in store
        assert threading.current_thread() is threading.main_thread()
        events.append(event)

    specs = plan(4)
    produce(specs, store, StubStudio(impossible=(specs[1].name,)), report=report)
    assert [event.spec for event in events if not isinstance(event, Notice)] == specs
    assert [type(event) for event in events] == [TakeMade, TakeSkipped, TakeMade, TakeMade]
    made, skipped = events[0], events[1]
    assert isinstance(made, TakeMade)
    assert isinstance(skipped, TakeSkipped)
    assert (made.frames, made.warnings, made.node) == (12, ("wobbly",), "")
    assert "impossible" in skipped.reason
    assert missing_takes([*specs, *specs], store) == [specs[1]]  # once


def test_takes_made_with_other_settings_do_not_count() -> None:
    store = TakeStore("memory://other-settings")
    settings = TakeSettings(views=1, cameras=CameraStyle(motion="orbit"))
    spec = replace(plan(1)[0], settings=settings)
    take, _ = StubStudio().make(spec)
    made = {"settings": settings.digest, "command": "quest generate --camera orbit"}
    store.write(replace(take, info=replace(take.info, provenance=made)))
    assert missing_takes([spec], store) == []
    for other in (TakeSettings(), TakeSettings(views=1), replace(settings, sensor=SENSORS["stereo"])):
        with pytest.raises(ConfigError, match="of other settings, made by `quest generate --camera orbit`"):
            missing_takes([replace(spec, settings=other)], store)


def test_takes_of_an_object_that_was_edited_since_do_not_count(tmp_path: Path) -> None:
    folder, store = write_cabinet(tmp_path / "mine"), TakeStore("memory://edited")
    spec = replace(plan(1)[0], source="own", object_id=str(folder))
    take, _ = StubStudio().make(spec)
    made = {"object": object_digest(folder)}
    store.write(replace(take, info=replace(take.info, provenance=made)))
    assert missing_takes([spec], store) == []
    with pytest.raises(ConfigError, match="of another"):
        missing_takes([replace(spec, source="partnet", object_id=folder.name)], store)
    (folder / "entities.json").write_text("{}")
    with pytest.raises(ConfigError, match="of another"):
        missing_takes([spec], store)


def test_an_object_is_its_materials_too(tmp_path: Path) -> None:
    folder = write_cabinet(tmp_path / "mine")
    mesh = next(folder.rglob("*.obj"))
    mesh.write_text("mtllib wood.mtl\n" + mesh.read_text())
    known = {object_digest(folder)}
    for name, text in (("wood.mtl", "newmtl a\nmap_Kd -s 1 1 oak.png\n"), ("oak.png", "light"), ("oak.png", "dark")):
        (mesh.parent / name).write_text(text)
        known.add(object_digest(folder))
    assert len(known) == 4


def test_two_objects_of_one_name_are_refused(tmp_path: Path) -> None:
    for where in ("a", "b"):
        (tmp_path / where / "urdf").mkdir(parents=True)
        (tmp_path / where / "urdf" / "mobility.urdf").touch()
    specs = [
        replace(spec, source="own", object_id=str(tmp_path / where / "urdf"))
        for spec in plan(1)
        for where in ("a", "b")
    ]
    with pytest.raises(ConfigError, match="rename the folder"):
        missing_takes(specs, TakeStore("memory://one-name"))


def test_what_was_made_before_a_failure_is_kept(store: TakeStore) -> None:
    class Breaking(StubStudio):
        def make(self, spec: TakeSpec) -> tuple[Take, tuple[str, ...]]:
            if spec.seed == 2:
                raise RendererError("it broke")
            return super().make(spec)

    events: list[Event] = []
    with pytest.raises(RendererError, match="it broke"):
        produce(plan(4), store, Breaking(), report=events.append)
    assert store.names() == [spec.name for spec in plan(2)]
    assert len(events) == 2


def test_a_failing_write_is_told(store: TakeStore, monkeypatch: pytest.MonkeyPatch) -> None:
    def full_disk(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(OSError, match="No space"):
        produce(plan(3), store, StubStudio(), report=lambda event: None)
    assert list(store.root.iterdir()) == []


def test_the_next_take_is_made_while_the_last_is_written(store: TakeStore, monkeypatch: pytest.MonkeyPatch) -> None:
    meeting = threading.Barrier(2, timeout=20)  # broken unless both are there at the same time

    class Meeting(StubStudio):
        def make(self, spec: TakeSpec) -> tuple[Take, tuple[str, ...]]:
            if spec.seed > 0:
                meeting.wait()
            return super().make(spec)

    write = TakeStore.write

    def meet_and_write(self: TakeStore, take: Take) -> None:
        if take.info.seed < 2:
            meeting.wait()
        write(self, take)

    monkeypatch.setattr(TakeStore, "write", meet_and_write)
    produce(plan(3), store, Meeting(), report=lambda event: None)
    assert len(store) == 3


def test_writing_what_another_process_wrote(store: TakeStore) -> None:
    spec = plan(1)[0]
    take, _ = StubStudio().make(spec)
    write_once(store, take)
    write_once(store, replace(take, info=replace(take.info, provenance={"maker": "another"})))
    with pytest.raises(TakeError, match="arrays differ"):
        write_once(store, replace(take, info=replace(take.info, seed=9)))


def test_objects_that_a_studio_lacks(tmp_path: Path) -> None:
    (tmp_path / "1").mkdir()
    (tmp_path / "1" / "mobility.urdf").write_text("<robot/>")
    specs = [TakeSpec("partnet", object_id, 1, 0) for object_id in ("1", "2")]
    with pytest.raises(ObjectError, match="objects 2: no such folders"):
        Studio(tmp_path).open(specs, complete=True)
    with pytest.raises(ObjectError):
        Studio(tmp_path / "nowhere").open([TakeSpec("partnet", "1", 1, 0)])


@pytest.fixture(params=["folder", "s3"])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    """Where a process that is killed writes to: a folder, and a prefix of a server that speaks S3."""
    if request.param == "folder":
        yield str(tmp_path / "takes")
    else:
        with s3_store("killed") as url:
            yield url


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="needs SIGKILL")
def test_killed_at_random_moments(place: str) -> None:
    """Every take is whole or absent, and in the end they are those of a run that nobody disturbed."""
    count, rng = 400, random.Random(4)
    # Forks of a process that has imported everything and done nothing yet: they start at once.
    processes = multiprocessing.get_context("forkserver")
    processes.set_forkserver_preload(["tests.sim.stub_studio"])
    store, specs, seen = TakeStore(place), plan(count), 0
    kills = 8 if store.is_folder else 3  # seconds each where a server answers
    for _ in range(kills):
        running = processes.Process(target=produce_missing, args=(place, count, dict(os.environ)))
        running.start()
        # Some way into the first, second or third take that it makes, however fast this machine is now.
        wait_for, patience = seen + rng.randrange(3), time.monotonic() + 60
        while wait_for > seen and specs[wait_for - 1].name not in store and time.monotonic() < patience:
            time.sleep(0.005)
        time.sleep(rng.uniform(0, 0.3))
        running.kill()
        running.join()
        assert running.exitcode == -signal.SIGKILL
        there = store.names()
        assert seen <= len(there) < count
        seen = len(there)
    assert seen >= kills // 2
    for name in store.names():
        store.verify(name)
    produce_missing(place, seen + 5, {})
    undisturbed = TakeStore(f"memory://undisturbed/{'folder' if store.is_folder else 's3'}")
    produce(plan(seen + 5), undisturbed, StubStudio(), report=lambda event: None)
    assert hashes(store) == hashes(undisturbed)
    assert len(store) == seen + 5
    assert store.problems() == {}
    if store.is_folder:
        assert {path.suffix for path in store.root.iterdir()} == {".zarr"}
