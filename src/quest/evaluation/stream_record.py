"""What the monitor is calibrated and judged on: the signals of a stream beside the truth, one file per stream."""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Int

from quest.errors import ConfigError, InputError
from quest.evaluation.metrics import SWITCH_FRAMES, distance_px, identity
from quest.evaluation.selection import Chosen, Shard
from quest.monitor import SIGNALS
from quest.monitor.calibration import Unit
from quest.track import Tracker
from quest.track.settings import REVISION
from quest.types import Query, Take
from quest.whole_file import whole_file

LIFTING_PX = 8.0
"""A seen entity whose pixel is this near to the true one is not lost, whatever its 3D point: pixels of the input."""

FORMAT = 2
"""Version of the files."""


@dataclass(frozen=True)
class StreamRecord:
    """One stream: a view of a take, watched by a tracker whose monitor was switched off."""

    take: str
    """Name of the take."""
    view: int
    """Index of the view."""
    object_id: str
    """The object."""
    source: str
    """``partnet-mobility`` or ``procedural``."""
    part: str
    """Part of the object split."""
    level: int
    """How many joints move one after the other."""
    signals: Float32[np.ndarray, "T K S"]
    """Per frame and query, in the order of :data:`quest.monitor.SIGNALS`; NaN where unknown."""
    lost: Bool[np.ndarray, "T K"]
    """Whether the identity is truly lost."""
    asked: Int[np.ndarray, " K"]
    """Frame in which each query was asked."""
    moved: Bool[np.ndarray, " K"]
    """Whether the entity is at some time more than 0.1 from rest."""
    confidence: Float32[np.ndarray, "T K"]
    """The network's own probability that the identity is right."""

    def __len__(self) -> int:
        return len(self.lost)

    @property
    def watched(self) -> Bool[np.ndarray, "T K"]:
        """Frames in which each query was followed."""
        return np.arange(len(self))[:, None] >= self.asked

    @property
    def loss_free(self) -> bool:
        """Whether no identity is ever lost."""
        return not (self.lost & self.watched).any()


def lost(
    take: Take,
    view: int,
    uv_px: Float32[np.ndarray, "T K 2"],
    point_world: Float32[np.ndarray, "T K 3"],
    entities: Int[np.ndarray, " K"],
) -> Bool[np.ndarray, "T K"]:
    """Whether an identity is lost: its answer is nearest to another entity, or within 0.1 of none, for 3 frames.

    A frame in which the entity is seen and the answer's pixel is within :data:`LIFTING_PX` of the true one is no loss:
    that is an error of lifting.

    Args:
        take: the truth.
        view: index of the view.
        uv_px: answers, pixels of the source image.
        point_world: answers, metres.
        entities: index in the take of the entity that each query asked for; all of them followable.
    """
    truth, camera = take.views[view], take.views[view].clip.camera
    rank = np.searchsorted(take.tracked, entities)
    nearest = identity(point_world, take.point_world[:, take.tracked], rank, half_diagonal_m=take.info.half_diagonal_m)
    gap_px = distance_px(uv_px, truth.uv_px[:, entities], width=camera.width, height=camera.height)
    on_it = truth.visible[:, entities] & (gap_px <= LIFTING_PX)
    return lasting((nearest != rank) & ~on_it)


def lasting(wrong: Bool[np.ndarray, "T K"], frames: int = SWITCH_FRAMES) -> Bool[np.ndarray, "T K"]:
    """The runs of True that are at least so many frames long."""
    kept = np.zeros_like(wrong)
    for k in range(wrong.shape[1]):
        for first, last in runs(wrong[:, k]):
            if last - first >= frames:
                kept[first:last, k] = True
    return kept


def runs(flags: Bool[np.ndarray, " T"]) -> list[tuple[int, int]]:
    """First frame, and frame after the last, of every run of True."""
    edges = np.flatnonzero(np.diff(flags.astype(np.int8), prepend=0, append=0))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def record_stream(tracker: Tracker, take: Take, view: int, *, part: str) -> StreamRecord | None:
    """Ask for every entity that is visible in frame 0 by its true pixel, and step through the view.

    Args:
        tracker: its monitor is switched off.
        take: with ground truth.
        view: index of the view.
        part: part of the object split.

    Returns:
        None if no entity is visible in frame 0.
    """
    truth = take.views[view]
    entities = take.tracked[truth.visible[0, take.tracked]]
    if not len(entities):
        return None
    # Names are neutral: a tracker must not read the label out of them.
    queries = [
        Query.point(0, float(x), float(y), name=f"query-{k}") for k, (x, y) in enumerate(truth.uv_px[0, entities])
    ]
    stream = tracker.stream(truth.clip.camera, queries, alpha=None)
    t, k = len(take), len(entities)
    signals = np.full((t, k, len(SIGNALS)), np.nan, np.float32)
    uv_px = np.full((t, k, 2), np.nan, np.float32)
    point_world = np.full((t, k, 3), np.nan, np.float32)
    for i in range(t):
        frame = truth.clip.frame(i)
        state = stream.step(frame.rgb, frame.depth_m, frame.stamp_s, frame.cam_from_world)
        rows = list(state.query)
        signals[i, rows], uv_px[i, rows], point_world[i, rows] = state.signals.values, state.uv_px, state.point_world
    return StreamRecord(
        take=take.info.name,
        view=view,
        object_id=take.info.object_id,
        source=take.info.source,
        part=part,
        level=take.info.level,
        signals=signals,
        lost=lost(take, view, uv_px, point_world, entities),
        asked=np.zeros(k, np.int64),
        moved=take.moved[entities],
        confidence=_confidence(signals),
    )


def by_unit(records: Sequence[StreamRecord], unit: Unit) -> tuple[StreamRecord, ...]:
    """The same streams; where promises are about takes, every take is an object of its own."""
    return tuple(replace(record, object_id=record.take) if unit == "take" else record for record in records)


def tracker_id(tracker: Tracker) -> str:
    """Twelve hexadecimal digits that tell apart networks, ways and settings of following given points, and signals.

    Streams are asked for by points. So a better affordance map or flow head, another threshold of discovery, or what
    else is in a weights file leaves records, and with them the monitor's calibration, as good as they were.
    """
    # Networks once said how their queries and head work; with that, records made before keep their name.
    said = {"flow": None, "queries": "anchored", "head": "heatmap"}
    config, settings = asdict(tracker.network.config) | said, asdict(tracker.config)
    del config["pieces"]
    settings = {name: value for name, value in settings.items() if not name.startswith(("slot_", "prompt_"))}
    digest = hashlib.sha256(json.dumps([config, settings, REVISION, SIGNALS], sort_keys=True).encode())
    for name, tensor in sorted(tracker.network.state_dict().items()):
        if name.startswith(("flow.", "affordance")):
            continue
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().float().numpy().tobytes())
    return digest.hexdigest()[:12]


@dataclass(frozen=True)
class Recorded:
    """What a folder has of the streams that were asked for."""

    records: tuple[StreamRecord, ...]
    """Read back, in the order of stores, takes and views."""
    missing: int
    """Streams that are left to other shards."""


def record_streams(
    tracker: Tracker,
    takes: Chosen,
    folder: Path,
    *,
    shard: Shard,
    progress: Callable[[str, int, int], None] = lambda name, done, total: None,
) -> Recorded:
    """Record every view of every take that the folder does not have yet, and read back what it has.

    Args:
        tracker: its monitor is switched off. Streams that another tracker recorded, or of takes that were made
            again since, are recorded again.
        takes: stores with the takes to use and their part of the object split.
        folder: one ``.npz`` per stream, written whole or not at all.
        shard: the part of the streams that this process records.
        progress: told of every stream before it is recorded: its name, how many come before it, how many there are.

    Raises:
        ConfigError: two stores have a take of the same name.
        TakeError: a take cannot be read.
    """
    names = [name for _, chosen in takes for name in chosen]
    if len(set(names)) < len(names):
        twice = sorted({name for name in names if names.count(name) > 1})
        raise ConfigError(f"records: expected different names of takes in all stores, {twice[0]!r} comes twice")
    made_by = tracker_id(tracker)
    hashes = {name: store.data_hash(name) for store, chosen in takes for name in chosen}
    streams = []
    for store, chosen in takes:
        headers = store.headers()
        streams += [(store, n, part, v) for n, part in chosen.items() for v in range(len(headers[n].cameras))]
    take: Take | None = None
    for i, (store, name, part, view) in enumerate(streams):
        path, of = folder / f"{name}-view{view}.npz", _Origin(made_by, hashes[name])
        if i not in shard or _origin(path) == of:
            continue
        progress(f"{name} view {view}", i, len(streams))
        take = take if take is not None and take.info.name == name else store.read(name)
        write_record(record_stream(tracker, take, view, part=part), path, made_by=made_by, take_hash=hashes[name])
    # Only now, since other shards went on meanwhile.
    paths = [(folder / f"{name}-view{view}.npz", part, hashes[name]) for _, name, part, view in streams]
    own = [(_read(path), part) for path, part, of in paths if _origin(path) == _Origin(made_by, of)]
    records = tuple(replace(record, part=part) for record, part in own if record is not None)
    return Recorded(records, len(streams) - len(own))


def write_record(record: StreamRecord | None, path: Path, *, made_by: str, take_hash: str) -> None:
    """Write a record whole or not at all; None leaves a mark that the stream has nothing to follow."""
    values: dict[str, Any] = {"format": np.array(FORMAT), "made_by": np.array(made_by)}
    values["take_hash"] = np.array(take_hash)
    values |= {} if record is None else {f.name: np.asarray(getattr(record, f.name)) for f in fields(StreamRecord)}
    with whole_file(path) as partial, partial.open("wb") as file:
        np.savez_compressed(file, **values)


def read_records(folder: str | Path, *, made_by: str) -> tuple[StreamRecord, ...]:
    """All records of a folder that one tracker made, by file name.

    Args:
        folder: that :func:`record_streams` filled.
        made_by: from :func:`tracker_id`.

    Raises:
        InputError: there are none, or one is damaged.
    """
    paths = sorted(Path(folder).glob("*.npz"))
    own = [_read(path) for path in paths if (origin := _origin(path)) is not None and origin.made_by == made_by]
    records = tuple(record for record in own if record is not None)
    if not records:
        raise InputError(
            f"records {folder}: expected streams of the tracker {made_by}, found none among {len(paths)} files; "
            "record them with `quest weights calibrate`"
        )
    return records


@dataclass(frozen=True)
class _Origin:
    """What a record is of: a tracker and a take."""

    made_by: str
    take_hash: str


def _origin(path: Path) -> _Origin | None:
    """What a record is of; None where there is none, or one of a format before."""
    if not path.exists():
        return None
    with _opened(path) as file:
        if int(file["format"]) != FORMAT:
            return None
        return _Origin(str(file["made_by"]), str(file["take_hash"]))


def _read(path: Path) -> StreamRecord | None:
    """A record; None where the stream has nothing to follow."""
    with _opened(path) as file:
        if "take" not in file:
            return None
        raw: dict[str, Any] = {f.name: file[f.name] for f in fields(StreamRecord)}
    plain = {name: value.item() if value.ndim == 0 else value for name, value in raw.items()}
    if plain["signals"].shape[-1] != len(SIGNALS):
        raise InputError(f"record {path}: it has other signals than this version of quest; delete it and record again")
    return StreamRecord(**plain)


@contextmanager
def _opened(path: Path) -> Iterator[Mapping[str, np.ndarray]]:
    try:
        with np.load(path, allow_pickle=False) as file:
            yield file
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"record {path}: not a whole record ({error}); delete it and record again") from error


def _confidence(signals: Float32[np.ndarray, "T K S"]) -> Float32[np.ndarray, "T K"]:
    """The network's own probability that the identity is right."""
    logit = signals[..., SIGNALS.index("right_logit")].astype(np.float64)
    return (1.0 / (1.0 + np.exp(-logit))).astype(np.float32)
