"""What a LeRobot v3 dataset that this project writes has in it: its episodes, features and where files lie.

Reference: lerobot 0.6.2, ``lerobot/datasets/utils.py`` and ``feature_utils.py``.
"""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float32

from quest.data.lerobot import CAMERA_KEY, POSE, STAMP, DepthRange
from quest.data.video import frame_rate
from quest.errors import InputError
from quest.types import Clip, State, Take, Tracks

STATE, TRACKS = "observation.state", "observation.tracks"

_VIEW_NAME = re.compile(r"[A-Za-z0-9_]+")
_COUNTERS = {"frame_index": "int64", "episode_index": "int64", "index": "int64", "task_index": "int64"}


@dataclass(frozen=True)
class Episode:
    """One episode to write.

    Attributes:
        views: clips of the same moments, by the name of their camera: letters, digits and underscores.
        task: what is done, in words.
        joint_position: radians or metres per frame; None without a state.
        joint_names: of its columns.
        tracks: answers or truth per view, all of the same entities; empty without.
    """

    views: dict[str, Clip]
    task: str
    joint_position: Float32[np.ndarray, "T J"] | None = None
    joint_names: tuple[str, ...] = ()
    tracks: dict[str, Tracks] = field(default_factory=dict)

    @classmethod
    def of_take(cls, take: Take, *, task: str | None = None) -> Episode:
        """A simulated take with its truth: joint positions, and the tracks of its entities but the hinges."""
        kept = take.tracked
        names = tuple(take.info.entities[i].name for i in kept)
        labels = tuple(take.info.entities[i].label for i in kept)
        tracks = {}
        for v, view in enumerate(take.views):
            visible = view.visible[:, kept]
            tracks[f"view_{v}"] = Tracks(
                names,
                labels,
                view.uv_px[:, kept].astype(np.float32),
                take.point_world[:, kept].astype(np.float32),
                np.ones(visible.shape, np.float32),
                visible,
                np.full(visible.shape, State.TRACKING.value),
                take.stamp_s,
            )
        return cls(
            {f"view_{v}": view.clip for v, view in enumerate(take.views)},
            task or f"open {take.info.category}",
            take.joint_position.astype(np.float32),
            tuple(joint.name for joint in take.info.joints),
            tracks,
        )


@dataclass(frozen=True)
class Layout:
    """What all episodes of a dataset share."""

    fps: int
    sizes: dict[str, tuple[int, int]]
    cameras: dict[str, dict[str, Any]]
    deep: frozenset[str]
    joints: int
    tracked: frozenset[str]
    entities: int
    depth_range: DepthRange

    @classmethod
    def of(
        cls, episode: Episode, fps: int | None, joints: int | None, entities: int | None, depth_range: DepthRange
    ) -> Layout:
        """The layout that an episode and what was asked for determine.

        Raises:
            InputError: no views, or a view whose name cannot be one of a feature.
        """
        bad = [name for name in episode.views if not _VIEW_NAME.fullmatch(name)]
        if bad or not episode.views:
            raise InputError(
                f"dataset: expected views named by letters, digits and underscores, got {bad or 'no view'}"
            )
        first = next(iter(episode.views.values()))
        own_joints = 0 if episode.joint_position is None else episode.joint_position.shape[1]
        own_entities = max((len(tracks.names) for tracks in episode.tracks.values()), default=0)
        return cls(
            fps=max(1, round(frame_rate(first.stamp_s))) if fps is None else fps,
            sizes={name: clip.rgb.shape[1:3] for name, clip in episode.views.items()},
            cameras={name: asdict(clip.camera) for name, clip in episode.views.items()},
            deep=frozenset(name for name, clip in episode.views.items() if clip.depth_m is not None),
            joints=own_joints if joints is None else joints,
            tracked=frozenset(episode.tracks),
            entities=own_entities if entities is None else entities,
            depth_range=depth_range,
        )

    def check(self, episode: Episode, index: int) -> int:
        """Number of frames of an episode; InputError if it does not fit."""
        where = f"dataset: episode {index}"
        lengths = {len(clip) for clip in episode.views.values()} | {len(tracks) for tracks in episode.tracks.values()}
        lengths |= set() if episode.joint_position is None else {len(episode.joint_position)}
        if len(lengths) != 1:
            raise InputError(f"{where}: views, joints and tracks are of {sorted(lengths)} frames, expected one number")
        sizes = {name: clip.rgb.shape[1:3] for name, clip in episode.views.items()}
        deep = {name for name, clip in episode.views.items() if clip.depth_m is not None}
        if sizes != self.sizes or deep != self.deep or set(episode.tracks) != self.tracked:
            raise InputError(
                f"{where}: views {sizes}, depth of {sorted(deep)}, tracks of {sorted(episode.tracks)}; expected those "
                f"of the first episode: {self.sizes}, {sorted(self.deep)}, {sorted(self.tracked)}"
            )
        own = 0 if episode.joint_position is None else episode.joint_position.shape[1]
        seen = max((len(tracks.names) for tracks in episode.tracks.values()), default=0)
        if own > self.joints or seen > self.entities or (self.joints and episode.joint_position is None):
            raise InputError(
                f"{where}: {own} joints and {seen} entities do not fit {self.joints} and {self.entities} places; say "
                "how many places the dataset needs"
            )
        return lengths.pop()

    def features(self) -> dict[str, Any]:
        """Features of ``meta/info.json``."""
        found: dict[str, Any] = {}
        for view, (height, width) in self.sizes.items():
            names = ["height", "width", "channels"]
            info = _video_info("h264", height, width, self.fps, 3) | {"is_depth_map": False}
            info[CAMERA_KEY] = self.cameras[view]
            found[image_key(view)] = {"dtype": "video", "shape": [height, width, 3], "names": names, "info": info}
            if view in self.deep:
                info = _video_info("hevc", height, width, self.fps, 1) | {"is_depth_map": True, "depth_unit": "m"}
                info |= {f"video.{name}": value for name, value in asdict(self.depth_range).items()}
                found[depth_key(view)] = {"dtype": "video", "shape": [height, width, 1], "names": names, "info": info}
        for key, (dtype, names) in self.columns().items():
            found[key] = {"dtype": dtype, "shape": [max(1, len(names or ()))], "names": names}
        return found

    def columns(self) -> dict[str, tuple[str, list[str] | None]]:
        """Element type and names of everything in the data files; None for single numbers."""
        found: dict[str, tuple[str, list[str] | None]] = {}
        if self.joints:
            found[STATE] = ("float32", [f"joint_{j}" for j in range(self.joints)])
        for view in self.sizes:
            if view in self.tracked and self.entities:
                places = [f"entity_{e}" for e in range(self.entities)]
                for what, axes in (("uv_px", "xy"), ("point_world", "xyz")):
                    names = [f"{place}.{axis}" for place in places for axis in axes]
                    found[f"{TRACKS}.{view}.{what}"] = ("float32", names)
                found[f"{TRACKS}.{view}.visible"] = ("bool", places)
                found[f"{TRACKS}.{view}.confidence"] = ("float32", places)
            found[f"{POSE}.{view}"] = ("float64", [f"m{row}{column}" for row in range(4) for column in range(4)])
        found[STAMP] = ("float64", None)
        found["timestamp"] = ("float32", None)
        return found | {name: (dtype, None) for name, dtype in _COUNTERS.items()}


def image_key(view: str) -> str:
    """Feature of a view's colours."""
    return f"observation.images.{view}"


def depth_key(view: str) -> str:
    """Feature of a view's depth."""
    return f"observation.images.{view}_depth"


def _video_info(codec: str, height: int, width: int, fps: int, channels: int) -> dict[str, Any]:
    odd = height % 2 or width % 2
    colour_format = "yuv444p" if odd else "yuv420p"
    return {
        "video.height": height,
        "video.width": width,
        "video.codec": codec,
        "video.pix_fmt": colour_format if channels == 3 else "gray12le",
        "video.fps": fps,
        "video.channels": channels,
        "has_audio": False,
    }
