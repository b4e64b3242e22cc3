"""Statistics of a store: what is in it, how much of it is seen, how far things move, what depth is missing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from quest.data.store import TakeStore
from quest.data.take_format import TakeHeader
from quest.data.verify import has_sensed_depth
from quest.types import LABELS

_DEPTH_FRAMES = 4
"""Frames of each view whose depth is looked at, spread over the take."""


@dataclass(frozen=True)
class Spread:
    """How a quantity is spread over its n values; NaN where there is none."""

    n: int
    """Number of values."""
    least: float
    """The least."""
    low: float
    """10 % lie below."""
    median: float
    """Half lie below."""
    high: float
    """90 % lie below."""
    most: float
    """The most."""

    @classmethod
    def of(cls, values: Iterable[np.ndarray | float]) -> Spread:
        """The spread of numbers and of the elements of arrays."""
        every = np.concatenate([np.zeros(0), *(np.ravel(np.asarray(v, dtype=np.float64)) for v in values)])
        if every.size == 0:
            return cls(0, *[float("nan")] * 5)
        return cls(every.size, *(float(q) for q in np.quantile(every, (0, 0.1, 0.5, 0.9, 1))))


@dataclass(frozen=True)
class StoreStats:
    """What is in a store. Entities are those that a tracker follows: hinges are counted, and left out of the rest."""

    takes: int
    """Whole takes."""
    unreadable: int
    """Groups that look like takes and cannot be read."""
    objects: int
    """Different objects."""
    views: int
    """Over all takes."""
    frames: int
    """Of all views."""
    hours: float
    """Of video, all views together."""
    stored_bytes: int
    """On disk."""
    sources: Mapping[str, int]
    """Takes per source."""
    categories: Mapping[str, int]
    """Takes per category."""
    levels: Mapping[str, int]
    """Takes per level."""
    suites: Mapping[str, int]
    """Takes per suite."""
    labels: Mapping[str, int]
    """Entities per label."""
    moving_cameras: int
    """Views whose camera moves."""
    with_depth_sensor: int
    """Takes whose depth went through the model of a depth sensor."""
    visible_share: float
    """Of all (frame, entity, view)."""
    visible_share_by_label: Mapping[str, float]
    """The same of each label."""
    never_seen: float
    """(entity, view) that are not seen in any frame, as a share."""
    moved_share: float
    """Entities that are at some time more than 0.1 normalised units from where they were."""
    motion: Spread
    """Farthest that an entity comes from where it was first, normalised units."""
    motion_m: Spread
    """The same in metres."""
    diagonal_m: Spread
    """Diagonal of the objects' bounding boxes at rest, one value per object."""
    distance_m: Spread
    """From the camera to an entity, at the first and the last frame."""
    image_px: Mapping[str, int]
    """Takes per size of their images."""
    depth_missing_share: float
    """Pixels without depth, in four frames of each view; NaN without depth."""
    depth_missing_share_on_object: float
    """The same among the pixels of the object."""


def store_stats(store: TakeStore, *, report: Callable[[int, int], None] = lambda done, of: None) -> StoreStats:
    """Read descriptions, the small arrays and a few depth images of every take.

    Args:
        store: the store.
        report: told how many takes are done, of how many.

    Raises:
        TakeError: a take's arrays cannot be decoded.
    """
    headers, tally = store.headers(), _Tally()
    for done, (name, header) in enumerate(headers.items(), start=1):
        tally.add(header, store.read_small_arrays(name))
        for v in np.flatnonzero(header.has_depth):
            for t in np.unique(np.linspace(0, header.frames - 1, _DEPTH_FRAMES).astype(int)):
                view = store.read_view(name, int(v), frames=slice(int(t), int(t) + 1))
                assert view.clip.depth_m is not None
                tally.add_depth(view.clip.depth_m, view.link_id)
        report(done, len(headers))
    return tally.result(list(headers.values()), len(store.problems()))


class _Tally:
    """Sums over takes."""

    def __init__(self) -> None:
        self.seen: dict[str, list[np.ndarray]] = {label: [] for label in LABELS}
        self.ever: list[np.ndarray] = []
        self.motion: list[np.ndarray] = []
        self.motion_m: list[np.ndarray] = []
        self.distance_m: list[np.ndarray] = []
        self.moving_cameras = 0
        self.pixels = np.zeros(4, dtype=np.int64)  # all, missing, of the object, missing of those

    def add(self, header: TakeHeader, arrays: Mapping[str, np.ndarray]) -> None:
        labels = np.array([entity.label for entity in header.info.entities])
        tracked = np.flatnonzero(np.isin(labels, LABELS))
        point = arrays["point_world"][:, tracked].astype(np.float64)
        moved_m = np.linalg.norm(point - point[:1], axis=-1).max(axis=0)
        self.motion_m.append(moved_m)
        self.motion.append(moved_m / header.info.half_diagonal_m)
        for v in range(len(header.cameras)):
            pose, visible = arrays[f"view_{v}/cam_from_world"], arrays[f"view_{v}/visible"]
            self.moving_cameras += not np.allclose(pose, pose[0], atol=1e-9)
            for label in LABELS:
                self.seen[label].append(visible[:, labels == label].ravel())
            self.ever.append(np.asarray(visible[:, tracked].any(axis=0)))
            ends = [0, -1]
            in_camera = np.einsum("tij,tej->tei", pose[ends, :3, :3], point[ends]) + pose[ends, None, :3, 3]
            self.distance_m.append(np.linalg.norm(in_camera, axis=-1))

    def add_depth(self, depth_m: np.ndarray, link_id: np.ndarray) -> None:
        missing, on_object = depth_m == 0, link_id > 0
        self.pixels += [missing.size, missing.sum(), on_object.sum(), (missing & on_object).sum()]

    def result(self, headers: list[TakeHeader], unreadable: int) -> StoreStats:
        infos = [header.info for header in headers]
        every_motion = np.concatenate([np.zeros(0), *self.motion])
        frames = [header.frames * len(header.cameras) for header in headers]
        pixels, missing, on_object, missing_on_object = (int(n) for n in self.pixels)
        objects = {(info.source, info.object_id): 2 * info.half_diagonal_m for info in infos}
        return StoreStats(
            takes=len(headers),
            unreadable=unreadable,
            objects=len(objects),
            views=sum(len(header.cameras) for header in headers),
            frames=sum(frames),
            hours=sum(n / info.frames_per_s for n, info in zip(frames, infos, strict=True)) / 3600,
            stored_bytes=sum(sum(header.files.values()) for header in headers),
            sources=_counted(info.source for info in infos),
            categories=_counted(info.category for info in infos),
            levels=_counted(str(info.level) for info in infos),
            suites=_counted(info.suite for info in infos),
            labels=_counted(entity.label for info in infos for entity in info.entities),
            moving_cameras=self.moving_cameras,
            with_depth_sensor=sum(has_sensed_depth(info) for info in infos),
            visible_share=_share([part for parts in self.seen.values() for part in parts]),
            visible_share_by_label={label: _share(parts) for label, parts in self.seen.items() if sum(map(len, parts))},
            never_seen=1 - _share(self.ever),
            moved_share=_share([every_motion > 0.1]),
            motion=Spread.of([every_motion]),
            motion_m=Spread.of(self.motion_m),
            diagonal_m=Spread.of(objects.values()),
            distance_m=Spread.of(self.distance_m),
            image_px=_counted(f"{h.cameras[0].width} x {h.cameras[0].height}" for h in headers if h.cameras),
            depth_missing_share=_ratio(missing, pixels),
            depth_missing_share_on_object=_ratio(missing_on_object, on_object),
        )


def _counted(values: Iterable[str]) -> dict[str, int]:
    """How often each value comes, the most frequent first."""
    return dict(Counter(values).most_common())


def _share(parts: list[np.ndarray]) -> float:
    return _ratio(sum(int(part.sum()) for part in parts), sum(part.size for part in parts))


def _ratio(part: int, whole: int) -> float:
    return float(part / whole) if whole else float("nan")
