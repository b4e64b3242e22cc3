"""Statistics of a store: what is in it, how much of it is seen, how far things move, what depth is missing."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from quest.data.store import TakeStore
from quest.data.take_format import TakeHeader
from quest.data.verify import has_sensed_depth, moved_points
from quest.types import LABELS

_DEPTH_FRAMES = 4
"""Frames of each view whose depth is looked at, spread over the take."""


@dataclass(frozen=True)
class Spread:
    """How a quantity is spread over its n values; NaN where there is none."""

    n: int
    least: float
    low: float
    """10 % lie below."""
    median: float
    """Half lie below."""
    high: float
    """90 % lie below."""
    most: float

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
    """Takes per source; so of categories, levels and suites."""
    categories: Mapping[str, int]
    levels: Mapping[str, int]
    suites: Mapping[str, int]
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
    """Read descriptions, the small arrays and a few depth images of every take; reports how many are done, of how many.

    Raises:
        TakeError: a take's arrays cannot be decoded.
    """
    headers, parts, pixels = store.headers(), defaultdict[str, list[np.ndarray]](list), np.zeros(4, np.int64)
    for done, (name, header) in enumerate(headers.items(), start=1):
        for what, values in _parts(header, store.read_small_arrays(name)):
            parts[what].append(values)
        for v in np.flatnonzero(header.has_depth):
            for t in np.unique(np.linspace(0, header.frames - 1, _DEPTH_FRAMES).astype(int)):
                view = store.read_view(name, int(v), frames=slice(int(t), int(t) + 1))
                assert view.clip.depth_m is not None
                missing, on_object = view.clip.depth_m == 0, view.link_id > 0
                pixels += [missing.size, missing.sum(), on_object.sum(), (missing & on_object).sum()]
        report(done, len(headers))
    infos = [header.info for header in headers.values()]
    frames = [header.frames * len(header.cameras) for header in headers.values()]
    objects = {(info.source, info.object_id): 2 * info.half_diagonal_m for info in infos}
    sizes = [header.cameras[0] for header in headers.values() if header.cameras]
    every, missing, on_object, missing_on_object = pixels.tolist()
    return StoreStats(
        takes=len(headers),
        unreadable=len(store.problems()),
        objects=len(objects),
        views=len(parts["moving"]),
        frames=sum(frames),
        hours=sum(n / info.frames_per_s for n, info in zip(frames, infos, strict=True)) / 3600,
        stored_bytes=sum(sum(header.files.values()) for header in headers.values()),
        sources=_counted(info.source for info in infos),
        categories=_counted(info.category for info in infos),
        levels=_counted(str(info.level) for info in infos),
        suites=_counted(info.suite for info in infos),
        labels=_counted(entity.label for info in infos for entity in info.entities),
        moving_cameras=sum(int(moving.sum()) for moving in parts["moving"]),
        with_depth_sensor=sum(has_sensed_depth(info) for info in infos),
        visible_share=_share([part for label in LABELS for part in parts[label]]),
        visible_share_by_label={n: _share(parts[n]) for n in LABELS if sum(map(len, parts[n]))},
        never_seen=1 - _share(parts["ever"]),
        moved_share=_share([motion > 0.1 for motion in parts["motion"]]),
        motion=Spread.of(parts["motion"]),
        motion_m=Spread.of(parts["motion_m"]),
        diagonal_m=Spread.of(objects.values()),
        distance_m=Spread.of(parts["distance_m"]),
        image_px=_counted(f"{camera.width} x {camera.height}" for camera in sizes),
        depth_missing_share=_ratio(missing, every),
        depth_missing_share_on_object=_ratio(missing_on_object, on_object),
    )


def _parts(header: TakeHeader, arrays: Mapping[str, np.ndarray]) -> Iterator[tuple[str, np.ndarray]]:
    """What is measured of a take; what is seen by the label of the entities."""
    labels = np.array([entity.label for entity in header.info.entities])
    tracked = np.flatnonzero(np.isin(labels, LABELS))
    point = arrays["point_world"][:, tracked].astype(np.float64)
    moved_m = np.linalg.norm(point - point[:1], axis=-1).max(axis=0)
    yield "motion_m", moved_m
    yield "motion", moved_m / header.info.half_diagonal_m
    for v in range(len(header.cameras)):
        pose, visible = arrays[f"view_{v}/cam_from_world"], arrays[f"view_{v}/visible"]
        yield "moving", np.array([not np.allclose(pose, pose[0], atol=1e-9)])
        for label in LABELS:
            yield label, visible[:, labels == label].ravel()
        yield "ever", np.asarray(visible[:, tracked].any(axis=0))
        yield "distance_m", np.linalg.norm(moved_points(pose[[0, -1]], point[[0, -1]]), axis=-1)


def _counted(values: Iterable[str]) -> dict[str, int]:
    """How often each value comes, the most frequent first."""
    return dict(Counter(values).most_common())


def _share(parts: list[np.ndarray]) -> float:
    return _ratio(sum(int(part.sum()) for part in parts), sum(part.size for part in parts))


def _ratio(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")
