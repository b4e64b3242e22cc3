"""A production on a Ray cluster of two nodes on this machine."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from quest.data.store import TakeStore
from quest.data.take_format import hash_take
from quest.errors import ConfigError, ObjectError, RendererError
from quest.sim.cluster import ClusterSettings, produce_on_cluster
from quest.sim.plan import TakeSpec
from quest.sim.production import Event, Notice, Studio, TakeMade, TakeSkipped, missing_takes, produce
from quest.sim.settings import TakeSettings
from tests.s3_server import s3_store
from tests.sim.small_objects import write_cabinet
from tests.sim.stub_studio import StubStudio, plan

ray = pytest.importorskip("ray")

pytestmark = [
    pytest.mark.slow,  # a cluster takes seconds to come up
    pytest.mark.skipif(os.name != "posix", reason="Ray has no clusters of several nodes elsewhere"),
]

ONE_CORE = ClusterSettings(cpus_per_worker=1)
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    with s3_store("bucket") as url:
        yield url


@pytest.fixture(scope="module")
def cluster(server: str) -> Iterator[str]:
    """Address of a cluster of two nodes with room for one worker each; workers know how to reach the server."""
    from ray.cluster_utils import Cluster

    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    small: dict[str, Any] = {"num_cpus": 1, "object_store_memory": 80_000_000}
    nodes = Cluster(initialize_head=True, head_node_args=small | {"include_dashboard": False})
    try:
        nodes.add_node(**small)
        ray.init(address=nodes.address, log_to_driver=False, logging_level="error")
        yield str(nodes.address)
    finally:
        ray.shutdown()
        nodes.shutdown()


def hashes(store: TakeStore) -> dict[str, str]:
    for name in store.names():
        store.verify(name)
    return {name: header.data_hash for name, header in store.headers().items()}


def expected(specs: list[TakeSpec]) -> dict[str, str]:
    """Digests of the takes that one process makes."""
    alone = TakeStore(f"memory://alone/{time.monotonic_ns()}")
    produce(specs, alone, StubStudio(), report=lambda event: None)
    return hashes(alone)


def test_many_workers_make_the_takes_of_one(cluster: str, tmp_path: Path) -> None:
    events: list[Event] = []
    store = TakeStore(tmp_path / "takes")
    specs = plan(10)
    impossible = specs[3]
    produce(specs[:2], store, StubStudio(), report=lambda event: None)
    studio = StubStudio(impossible=(impossible.name,), notes=tmp_path, seconds=1.0)  # both workers have started by then
    produce_on_cluster(missing_takes(specs, store), store, studio, ONE_CORE, report=events.append)
    possible = [spec for spec in specs if spec != impossible]
    assert hashes(store) == expected(possible)
    made = [event for event in events if isinstance(event, TakeMade)]
    assert sorted(event.spec.seed for event in made) == [2, *range(4, 10)]
    assert all(event.frames == 12 and event.warnings == ("wobbly",) for event in made)
    assert len({event.node for event in made}) == 2
    assert [event.spec for event in events if isinstance(event, TakeSkipped)] == [impossible]
    assert len({path.name.rpartition("-")[2] for path in tmp_path.glob("made-*")}) == 2


def test_workers_that_are_killed_lose_nothing(cluster: str, server: str, tmp_path: Path) -> None:
    """SIGKILL to a worker's process, at random moments, again and again, where takes go to a server."""
    store = TakeStore(f"{server}/{tmp_path.name}")
    specs, events, rng = plan(10), [], random.Random(0)
    done = threading.Event()
    killed: set[int] = set()

    def kill() -> None:
        while not done.wait(rng.uniform(0.2, 0.8)) and len(killed) < 2:
            living = {int(path.name.rpartition("-")[2]) for path in tmp_path.glob("made-*")} - killed
            if living:
                victim = max(living)
                killed.add(victim)
                os.kill(victim, signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    try:
        studio = StubStudio(notes=tmp_path, seconds=0.4)
        produce_on_cluster(specs, store, studio, ONE_CORE, report=events.append)
    finally:
        done.set()
        killer.join()
    assert len(killed) == 2
    assert sum(isinstance(event, Notice) and "a worker died" in event.text for event in events) >= 2
    assert sorted(event.spec.seed for event in events if isinstance(event, TakeMade)) == list(range(10))
    assert hashes(store) == expected(specs)
    assert store.problems() == {}


def test_a_take_that_kills_is_given_up(cluster: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("quest.sim.cluster._ATTEMPTS", 2)
    specs = plan(3)
    store = TakeStore(tmp_path / "takes")
    studio = StubStudio(deadly=(specs[1].name,), notes=tmp_path)
    with pytest.raises(RendererError, match=f"{specs[1].name}.* 2 workers died over it"):
        produce_on_cluster(specs, store, studio, ONE_CORE, report=lambda event: None)
    assert set(store.names()) <= {specs[0].name, specs[2].name}


def test_what_is_wrong_with_a_node_is_told_with_its_name(cluster: str, tmp_path: Path) -> None:
    """No renderer, or an object that it lacks: else it would depend on who makes a take whether it can be made."""
    store = TakeStore(tmp_path / "takes")
    with pytest.raises(RendererError, match=r"node .+/[0-9a-f]{8}: no device can render"):
        produce_on_cluster(plan(2), store, StubStudio(broken=True), ONE_CORE, report=lambda event: None)
    (tmp_path / "1").mkdir()
    (tmp_path / "1" / "mobility.urdf").write_text("<robot/>")
    specs = [TakeSpec("partnet", object_id, 1, 0) for object_id in ("1", "44817")]
    studio = Studio(tmp_path)
    with pytest.raises(ObjectError, match=r"node .+/[0-9a-f]{8}: objects 44817: no such folders"):
        produce_on_cluster(specs, store, studio, ONE_CORE, report=lambda event: None)


def test_settings_that_cannot_work(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="at least 1 core"):
        ClusterSettings(cpus_per_worker=0)
    with pytest.raises(ConfigError, match="cannot reach this process's memory"):
        produce_on_cluster(plan(1), TakeStore("memory://x"), StubStudio(), ONE_CORE, report=lambda event: None)


def test_a_cluster_that_is_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    nobody = ClusterSettings("127.0.0.1:9")
    with pytest.raises(ConfigError, match=r"cluster '127.0.0.1:9': cannot be reached .*refused.*HOST:PORT"):
        produce_on_cluster(plan(1), TakeStore("takes"), StubStudio(), nobody, report=lambda event: None)


INTERRUPTED = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
from quest.data.store import TakeStore
from quest.sim.cluster import ClusterSettings, produce_on_cluster
from tests.sim.stub_studio import StubStudio, plan
studio = StubStudio(seconds=0.1)
produce_on_cluster(plan(500), TakeStore(sys.argv[1]), studio, ClusterSettings("local", 1), report=lambda event: None)
"""


def test_an_interrupted_production_leaves_whole_takes(tmp_path: Path) -> None:
    """Ctrl-C on a cluster of its own."""
    store = TakeStore(tmp_path / "takes")
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "src")])}
    running = subprocess.Popen([sys.executable, "-c", INTERRUPTED, store.url], env=environment, stderr=subprocess.PIPE)
    try:
        patience = time.monotonic() + 180
        while len(store) < 2 and time.monotonic() < patience and running.poll() is None:
            time.sleep(0.05)
        running.send_signal(signal.SIGINT)
        _, message = running.communicate(timeout=150)
    finally:
        running.kill()
    assert b"KeyboardInterrupt" in message
    assert 2 <= len(store) < 500
    assert store.problems() == {}
    made = hashes(store)
    time.sleep(1)
    assert hashes(store) == made  # nobody goes on
    assert made.items() <= expected(plan(40)).items() or len(made) > 40


@pytest.mark.render
@pytest.mark.timeout(900)
def test_a_worker_renders_what_one_process_renders(cluster: str, tmp_path: Path) -> None:
    write_cabinet(tmp_path / "objects" / "cabinet")
    settings = TakeSettings(views=1, size=48, every=8, frames_per_joint=24)
    spec = TakeSpec("partnet", "cabinet", 1, 0, settings)
    store = TakeStore(tmp_path / "takes")
    studio = Studio(tmp_path / "objects")
    produce_on_cluster([spec], store, studio, ONE_CORE, report=lambda event: None)
    studio.open([spec])
    take, _ = studio.make(spec)
    assert hashes(store) == {spec.name: hash_take(take)}
