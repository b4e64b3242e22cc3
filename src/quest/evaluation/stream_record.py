"""What the monitor is calibrated and judged on: log odds of a loss beside the truth, one file per stream."""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int, Int8

from quest.errors import ConfigError, InputError
from quest.evaluation.metrics import INPUT_PX, distance_px
from quest.evaluation.protocols import true_queries
from quest.evaluation.selection import Chosen, Shard
from quest.filter.queries import READINGS
from quest.monitor import Inputs
from quest.monitor.calibration import Unit
from quest.track import Tracker
from quest.track.settings import REVISION
from quest.types import Take
from quest.whole_file import whole_file

RIGHT, UNCLEAR, LOST = range(3)
"""Bands: what an answer is beside the truth."""

NEAR, FAR = 0.07, 0.14
"""An answer is right up to the first distance, and lost beyond the second; normalised units."""

NEAR_PX, FAR_PX, WIDTH_PX = 12.0, 32.0, 640
"""The same for colours alone: pixels of a picture of this width."""

LIFTING_PX = 8.0
"""A seen entity whose pixel is this near to the true one is right, whatever its 3D point: pixels of the input."""

LEAST_S = 0.1
"""What is lost for a shorter time is unclear, seconds."""

FORMAT = 5
"""Version of the files."""


@dataclass(frozen=True)
class StreamRecord:
    """One stream: a view of a take, watched by a tracker whose monitor was switched off."""

    take: str
    view: int
    object_id: str
    source: str
    part: str
    level: int
    """How many joints move one after the other."""
    inputs: Inputs
    stamp_s: Float64[np.ndarray, " T"]
    """Time of each frame, seconds."""
    log_odds: Float32[np.ndarray, "T K"]
    """The tracker's own, that the query is lost; NaN until it is asked."""
    readings: Float32[np.ndarray, "T K R"]
    """What tells that (:data:`quest.filter.queries.READINGS`); NaN where nothing does, and of colours alone."""
    band: Int8[np.ndarray, "T K"]
    """:data:`RIGHT`, :data:`UNCLEAR` or :data:`LOST`."""
    asked: Int[np.ndarray, " K"]
    """Frame in which each query was asked."""
    moved: Bool[np.ndarray, " K"]
    """Whether the entity is at some time more than 0.1 from rest."""

    def __len__(self) -> int:
        return len(self.band)

    @property
    def watched(self) -> Bool[np.ndarray, "T K"]:
        """Frames in which each query was followed."""
        return np.arange(len(self))[:, None] >= self.asked

    @property
    def lost(self) -> Bool[np.ndarray, "T K"]:
        """Where a query that is followed is truly lost."""
        return self.watched & (self.band == LOST)

    @property
    def right(self) -> Bool[np.ndarray, "T K"]:
        """Where a query that is followed is right."""
        return self.watched & (self.band == RIGHT)

    @property
    def judged(self) -> Bool[np.ndarray, "T K"]:
        """Where a query has log odds, and is right or lost."""
        return (self.right | self.lost) & np.isfinite(self.log_odds)

    @property
    def loss_free(self) -> bool:
        """Whether no query is ever lost."""
        return not self.lost.any()


def bands(
    take: Take,
    view: int,
    uv_px: Float32[np.ndarray, "T K 2"],
    point_world: Float32[np.ndarray, "T K 3"],
    entities: Int[np.ndarray, " K"],
    *,
    inputs: Inputs,
) -> Int8[np.ndarray, "T K"]:
    """The band of every answer; a missing answer is as far off as can be.

    With depth an answer is right whose 3D point is at most :data:`NEAR` from the true one and nearest to its own
    entity; so is one whose entity is seen and whose pixel is within :data:`LIFTING_PX`. It is lost beyond :data:`FAR`,
    and beyond :data:`NEAR` where another entity is less than half as far away. Of colours alone pixels tell the same,
    while the entity is in view. What is lost for less than :data:`LEAST_S` is unclear.
    """
    truth, camera = take.views[view], take.views[view].clip.camera
    answer_px, true_px = np.broadcast_arrays(uv_px[:, :, None], truth.uv_px[:, None, take.tracked])
    gap_px = distance_px(answer_px, true_px, width=camera.width, height=camera.height)
    if inputs == "depth":
        gap = np.linalg.norm(
            point_world[:, :, None].astype(np.float64) - take.point_world[:, None, take.tracked], axis=-1
        )
        near, far, unit = NEAR, FAR, take.info.half_diagonal_m
    else:
        gap, near, far, unit = gap_px, NEAR_PX, FAR_PX, INPUT_PX / WIDTH_PX
    gap = np.where(np.isfinite(gap), gap / unit, np.inf)
    rank = np.searchsorted(take.tracked, entities)
    own_is = np.arange(len(take.tracked)) == rank[:, None]
    own, other = gap[:, own_is], np.where(own_is, np.inf, gap).min(axis=-1)
    if inputs == "depth":
        right = (own <= near) & (own <= other) | truth.visible[:, entities] & (gap_px[:, own_is] <= LIFTING_PX)
        known = np.ones_like(right)
    else:
        right = own <= near
        at = truth.uv_px[:, entities]
        known = ((at >= 0) & (at <= [camera.width, camera.height])).all(axis=-1)
    lost = lasting(known & ~right & ((own > far) | (own > near) & (other < own / 2)), take.stamp_s, LEAST_S)
    return np.select([known & right, lost], [RIGHT, LOST], UNCLEAR).astype(np.int8)


def lasting(
    wrong: Bool[np.ndarray, "T K"], stamp_s: Float64[np.ndarray, " T"], least_s: float
) -> Bool[np.ndarray, "T K"]:
    """The runs of True that last at least so many seconds; see :func:`duration_s`."""
    kept = np.zeros_like(wrong)
    for k in range(wrong.shape[1]):
        for first, last in runs(wrong[:, k]):
            kept[first:last, k] = duration_s(stamp_s, first, last) >= least_s
    return kept


def duration_s(stamp_s: Float64[np.ndarray, " T"], first: int, last: int) -> float:
    """Seconds from a frame to the one after the last; the last frame of a stream lasts as long as others do.

    Rounded, because stamps are: three 30ths of a second are a tenth, however they were written down.
    """
    mean_s = float(np.diff(stamp_s).mean()) if len(stamp_s) > 1 else 0.0
    end_s = stamp_s[last] if last < len(stamp_s) else stamp_s[-1] + mean_s
    return round(float(end_s - stamp_s[first]), 3)


def runs(flags: Bool[np.ndarray, " T"]) -> list[tuple[int, int]]:
    """First frame, and frame after the last, of every run of True."""
    edges = np.flatnonzero(np.diff(flags.astype(np.int8), prepend=0, append=0))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def record_stream(tracker: Tracker, take: Take, view: int, *, part: str, inputs: Inputs) -> StreamRecord | None:
    """Ask for every entity that is visible in frame 0 by its true pixel, and step through the view.

    The monitor of the tracker is switched off.

    Returns:
        None if no entity is visible in frame 0.
    """
    truth = take.views[view]
    entities = take.tracked[truth.visible[0, take.tracked]]
    if not len(entities):
        return None
    queries = true_queries(truth, entities, [0] * len(entities))
    stream = tracker.stream(truth.clip.camera, queries, alpha=None)
    t, k = len(take), len(entities)
    log_odds, readings = np.full((t, k), np.nan, np.float32), np.full((t, k, len(READINGS)), np.nan, np.float32)
    uv_px = np.full((t, k, 2), np.nan, np.float32)
    point_world = np.full((t, k, 3), np.nan, np.float32)
    for i in range(t):
        frame = truth.clip.frame(i)
        depth_m = frame.depth_m if inputs == "depth" else None
        state = stream.step(frame.rgb, depth_m, frame.stamp_s, frame.cam_from_world)
        rows = list(state.query)
        log_odds[i, rows], uv_px[i, rows], point_world[i, rows] = state.lost_log_odds, state.uv_px, state.point_world
        if inputs == "depth" and (followed := stream.memory.filter) is not None:
            readings[i, rows] = followed.queries.readings
    return StreamRecord(
        take=take.info.name,
        view=view,
        object_id=take.info.object_id,
        source=take.info.source,
        part=part,
        level=take.info.level,
        inputs=inputs,
        stamp_s=take.stamp_s,
        log_odds=log_odds,
        readings=readings,
        band=bands(take, view, uv_px, point_world, entities, inputs=inputs),
        asked=np.zeros(k, np.int64),
        moved=take.moved[entities],
    )


def by_unit(records: Sequence[StreamRecord], unit: Unit) -> tuple[StreamRecord, ...]:
    """The same streams; where promises are about takes, every take is an object of its own."""
    return tuple(replace(record, object_id=record.take) if unit == "take" else record for record in records)


def tracker_id(tracker: Tracker) -> str:
    """Twelve hexadecimal digits that tell apart the noise, picture size and code of trackers, and versions of records.

    Streams are asked for by points, which the filter follows by itself: no network has a part in it.
    """
    made_of = json.dumps([asdict(tracker.noise), tracker.config.follow_px, REVISION, FORMAT], sort_keys=True)
    return hashlib.sha256(made_of.encode()).hexdigest()[:12]


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
    inputs: Inputs,
    shard: Shard,
    progress: Callable[[str, int, int], None] = lambda name, done, total: None,
) -> Recorded:
    """Record every view of every take that the folder does not have yet, and read back what it has.

    Args:
        tracker: its monitor is switched off. Streams that another tracker recorded, or of takes that were made
            again since, are recorded again.
        takes: stores with the takes to use and their part of the object split.
        folder: one ``.npz`` per stream, written whole or not at all.
        inputs: what the tracker sees of the frames.
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
        for name, part in chosen.items():
            paths = [folder / f"{name}-view{v}-{inputs}.npz" for v in range(len(headers[name].cameras))]
            streams += [(store, name, part, view, path) for view, path in enumerate(paths)]
    take: Take | None = None
    for i, (store, name, part, view, path) in enumerate(streams):
        if i not in shard or _find(path, made_by, hashes[name]) is not None:
            continue
        progress(f"{name} view {view}, {inputs}", i, len(streams))
        take = take if take is not None and take.info.name == name else store.read(name)
        record = record_stream(tracker, take, view, part=part, inputs=inputs)
        write_record(record, path, made_by=made_by, take_hash=hashes[name])
    # Only now, since other shards went on meanwhile.
    found = [(_find(path, made_by, hashes[name]), part) for _, name, part, _, path in streams]
    known = [(own, part) for own, part in found if own is not None]
    return Recorded(
        tuple(replace(record, part=part) for own, part in known for record in own), len(streams) - len(known)
    )


def write_record(record: StreamRecord | None, path: Path, *, made_by: str, take_hash: str) -> None:
    """Write a record whole or not at all; None leaves a mark that the stream has nothing to follow."""
    values: dict[str, Any] = {"format": FORMAT, "made_by": made_by, "take_hash": take_hash}
    values |= {} if record is None else vars(record)
    with whole_file(path) as partial:
        np.savez_compressed(partial, **values)


def read_records(folder: str | Path, *, inputs: Inputs, made_by: str) -> tuple[StreamRecord, ...]:
    """All records of a folder that one tracker made of one kind of frames, by file name.

    Raises:
        InputError: there are none, or one is damaged.
    """
    paths = sorted(Path(folder).glob(f"*-{inputs}.npz"))
    records = tuple(record for path in paths for record in _find(path, made_by) or ())
    if not records:
        raise InputError(
            f"records {folder}: expected streams of the tracker {made_by}, found none among {len(paths)} files of "
            f"{inputs}; record them with `quest calibrate`"
        )
    return records


def _find(path: Path, made_by: str, take_hash: str | None = None) -> list[StreamRecord] | None:
    """The record in a file, or none if the stream has nothing to follow; None without one of this tracker and take."""
    if not path.exists():
        return None
    try:
        with np.load(path, allow_pickle=False) as file:
            if int(file["format"]) != FORMAT or str(file["made_by"]) != made_by:
                return None
            if take_hash not in (None, str(file["take_hash"])):
                return None
            if "take" not in file:
                return []
            raw: dict[str, Any] = {f.name: file[f.name] for f in fields(StreamRecord)}
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"record {path}: not a whole record ({error}); delete it and record again") from error
    return [StreamRecord(**{name: value.item() if value.ndim == 0 else value for name, value in raw.items()})]
