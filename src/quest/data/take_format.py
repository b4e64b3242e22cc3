"""What a take looks like on disk: its description as JSON, its arrays, and how to tell that it is whole.

A take is one Zarr v3 group. The group's attributes (:class:`TakeHeader`) are written last and list every file of the
group with its size, so that a missing or truncated file is noticed without reading any pixel. In a folder the arrays
lie directly in the group; in an object store they lie in a subgroup that the attribute ``arrays_at`` names.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass

import numpy as np

from quest.errors import InputError, TakeError
from quest.types import Camera, Take, TakeInfo
from quest.untrusted import build, is_inside, is_name, parse_json, reading

FORMAT = "quest-take"
VERSIONS = (1, 2)
"""Versions that are read: 1 has its arrays directly in the group, 2 in a subgroup."""
DEPTH_SCALE_M = 1e-4
"""Metres per stored unit of depth; 16 bits reach 6.5535 m."""

TAKE_ARRAYS: dict[str, type] = {
    "stamp_s": np.float64,
    "point_world": np.float32,
    "flow_world": np.float32,
    "link_pose": np.float32,
    "joint_position": np.float32,
    "joint_velocity": np.float32,
    "joint_axis": np.float32,
}
VIEW_ARRAYS: dict[str, type] = {"uv_px": np.float32, "visible": np.bool_, "link_id": np.uint8, "entity_id": np.uint8}

HEADER_FILE = "zarr.json"
REMEDY = "delete its folder and generate it again"


@dataclass(frozen=True)
class TakeHeader:
    """Everything about a stored take but its arrays."""

    info: TakeInfo
    frames: int
    cameras: tuple[Camera, ...]
    """One per view, as are names and whether there is depth."""
    clip_names: tuple[str, ...]
    has_depth: tuple[bool, ...]
    data_hash: str
    """Digest of arrays and description, see :func:`hash_take`."""
    files: Mapping[str, int]
    """Size in bytes of every file of the group but the header itself, by relative path."""
    arrays_at: str = ""
    """Subgroup that holds the arrays; empty where they lie directly in the group."""

    def to_json(self) -> bytes:
        """The file :data:`HEADER_FILE` of the group."""
        views = zip(self.clip_names, self.cameras, self.has_depth, strict=True)
        attributes = {
            "format": FORMAT,
            "version": 2 if self.arrays_at else 1,
            "depth_scale_m": DEPTH_SCALE_M,
            "info": asdict(self.info),
            "frames": self.frames,
            "views": [asdict(_View(*view)) for view in views],
            "data_hash": self.data_hash,
            "files": dict(self.files),
            **({"arrays_at": self.arrays_at} if self.arrays_at else {}),
        }
        return json.dumps({"attributes": attributes, "zarr_format": 3, "node_type": "group"}, indent=2).encode()


@dataclass(frozen=True)
class _View:
    name: str
    camera: Camera
    has_depth: bool


def parse_header(name: str, where: str, data: bytes | None) -> TakeHeader:
    """Header of a take from the content of its :data:`HEADER_FILE`; None if there is no such file.

    Raises:
        TakeError: the file is missing or damaged, or is that of another group or format version; it names ``where``.
    """
    if data is None:
        raise TakeError(f"take {name!r}: {where} holds no {HEADER_FILE}, so it is torn or not a take; {REMEDY}")
    file = f"take {name!r}: {where}/{HEADER_FILE}"
    group = parse_json(data, file, TakeError)
    attributes = group.get("attributes") if isinstance(group, dict) else None
    if not isinstance(attributes, dict) or attributes.get("format") != FORMAT:
        raise TakeError(
            f"take {name!r}: {where} is a Zarr group but not a take (no format {FORMAT!r}); give a take's folder"
        )
    if attributes.get("version") not in VERSIONS:
        raise TakeError(
            f"take {name!r}: {where} has format version {attributes.get('version')!r}, expected "
            f"{' or '.join(map(str, VERSIONS))}; generate it again, or use the version of quest that wrote it"
        )
    with reading(file, TakeError, REMEDY):
        views = build(list[_View], attributes["views"], "views")
        header = TakeHeader(
            info=build(TakeInfo, attributes["info"], "info"),
            frames=build(int, attributes["frames"], "frames"),
            cameras=tuple(view.camera for view in views),
            clip_names=tuple(view.name for view in views),
            has_depth=tuple(view.has_depth for view in views),
            data_hash=build(str, attributes["data_hash"], "data_hash"),
            files=build(dict[str, int], attributes["files"], "files"),
            arrays_at=build(str, attributes.get("arrays_at", ""), "arrays_at"),
        )
        if min(header.frames, header.info.frames_per_s, header.info.half_diagonal_m) <= 0:
            raise ValueError("frames, frames_per_s and half_diagonal_m are to be positive")
    if header.info.name != name or not is_name(name):
        raise TakeError(f"{file} is of a take of another name, {header.info.name!r}; give its folder that name")
    if outside := [path for path in header.files if not is_inside(path)]:
        raise TakeError(f"{file} lists files outside of the take, such as {outside[0]!r}; {REMEDY}")
    return header


def encode_depth(depth_m: np.ndarray) -> np.ndarray:
    """Depth in metres as 16-bit units of :data:`DEPTH_SCALE_M`.

    What is not finite, not positive, or beyond the range of 16 bits (6.55 m) becomes 0, missing: a clipped depth would
    claim a surface where there is none.
    """
    with np.errstate(invalid="ignore"):  # NaN compares false, which is what is wanted
        units = np.rint(depth_m * np.float32(1 / DEPTH_SCALE_M))
        inside = (units > 0) & (units <= np.iinfo(np.uint16).max)
    return np.where(inside, units, 0).astype(np.uint16)


def decode_depth(units: np.ndarray) -> np.ndarray:
    """Depth in metres from 16-bit units, float32."""
    return units.astype(np.float32) * np.float32(DEPTH_SCALE_M)


def take_arrays(take: Take) -> Iterator[tuple[str, np.ndarray]]:
    """Path in the group and stored form of every array of a take, in a fixed order."""
    for name, dtype in TAKE_ARRAYS.items():
        yield name, np.ascontiguousarray(getattr(take, name), dtype=dtype)
    for v, view in enumerate(take.views):
        yield f"view_{v}/cam_from_world", np.ascontiguousarray(view.clip.cam_from_world, dtype=np.float64)
        yield f"view_{v}/rgb", np.ascontiguousarray(view.clip.rgb, dtype=np.uint8)
        if view.clip.depth_m is not None:
            yield f"view_{v}/depth", encode_depth(view.clip.depth_m)
        for name, dtype in VIEW_ARRAYS.items():
            yield f"view_{v}/{name}", np.ascontiguousarray(getattr(view, name), dtype=dtype)


class TakeHash:
    """Digest of a take's stored arrays and its description without provenance, fed one array after the other."""

    def __init__(self, info: TakeInfo, cameras: tuple[Camera, ...]) -> None:
        described = asdict(info)
        described.pop("provenance")
        if info.suite == "standard":
            described.pop("suite")  # takes that were written before there were suites keep their digest
        described["cameras"] = [asdict(camera) for camera in cameras]
        self._digest = hashlib.sha256(json.dumps(described, sort_keys=True).encode())

    def add(self, path: str, array: np.ndarray) -> None:
        """Take one array in."""
        self._digest.update(f"{path} {array.dtype.str} {array.shape}".encode())
        self._digest.update(np.ascontiguousarray(array).data)

    def hexdigest(self) -> str:
        """The digest of what was added so far."""
        return self._digest.hexdigest()


def hash_take(take: Take) -> str:
    """Digest of a take as it is stored."""
    digest = TakeHash(take.info, tuple(view.clip.camera for view in take.views))
    for path, array in take_arrays(take):
        digest.add(path, array)
    return digest.hexdigest()


def check_take(take: Take) -> None:
    """Raise InputError if the arrays of a take contradict each other or its description."""
    frames, entities, joints = len(take), len(take.info.entities), len(take.info.joints)
    links = take.link_pose.shape[1] if take.link_pose.ndim == 4 else -1
    shapes = dict.fromkeys(("point_world", "flow_world"), (frames, entities, 3)) | {"link_pose": (frames, links, 4, 4)}
    shapes |= dict.fromkeys(("joint_position", "joint_velocity"), (frames, joints)) | {
        "joint_axis": (frames, joints, 6)
    }
    checked = [(name, getattr(take, name), shape) for name, shape in shapes.items()]
    for v, view in enumerate(take.views):
        size = view.clip.rgb.shape[1:3]
        shapes = {"uv_px": (frames, entities, 2), "visible": (frames, entities)}
        shapes |= dict.fromkeys(("link_id", "entity_id"), (frames, *size))
        checked.append((f"view {v} rgb", view.clip.rgb, (frames, *size, 3)))
        checked += [(f"view {v} {name}", getattr(view, name), shape) for name, shape in shapes.items()]
        if not np.array_equal(view.clip.stamp_s, take.stamp_s):
            raise InputError(f"take {take.info.name!r}: view {v} has other time stamps than the take; views share them")
    for name, array, shape in checked:
        if array.shape != shape:
            raise InputError(f"take {take.info.name!r}: {name} has shape {array.shape}, expected {shape}")
    if frames == 0 or not take.views:
        raise InputError(f"take {take.info.name!r}: expected at least one frame and one view")
