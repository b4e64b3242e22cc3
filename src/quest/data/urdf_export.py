"""The joints of tracks as a URDF: what a planner or a simulator loads to move an object that was seen once.

Axes and origins are those of the tracks' world, which is the link ``world``; lengths are metres, angles radians.
"""

from __future__ import annotations

import json
import re
import unicodedata
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import numpy as np
from jaxtyping import Float

from quest.errors import InputError
from quest.tracks import Tracks
from quest.whole_file import whole_file

WORLD = "world"
_SPHERE_M = 0.01
_UNLIMITED = 1000.0
"""What stands for a largest effort and velocity: URDF asks for numbers, and nothing is known of them."""


@dataclass(frozen=True)
class UrdfNames:
    """What a file calls the tracks that are in it."""

    link: dict[int, str]
    """Name of the link at each entity, by the number of its track."""
    left_out: tuple[str, ...]
    """Names of the tracks whose joint is not known."""


def write_urdf(tracks: Tracks, path: str | Path) -> UrdfNames:
    """Write the joints of tracks as a URDF, all or nothing; an existing file is replaced.

    Each track of a known joint has a link, whose frame lies at its entity, along the world's axes at q = 0. Its joint
    is ``NAME_joint``, from ``world``, with the axis and the range that were seen. A turning joint's frame must lie on
    its axis, so that it moves the link ``NAME_hinge``, to which the entity's link is fixed. Efforts and velocities are
    not known: 1000 stands for no limit. A comment above each joint holds, as JSON, the name that the track had, and
    how uncertain axis and origin are. Returned is which links there are, and which tracks were left out.

    Raises:
        InputError: the tracks have no joints.
    """
    joints = tracks.joints
    if joints is None:
        raise InputError(f"URDF {path}: these tracks have no joints; quest gives them, for frames with depth")
    rest = joints.rest(tracks.point_world, tracks.state)
    known = [k for k in range(len(joints)) if joints.kind[k] != "unknown" and np.isfinite(rest[k]).all()]
    names = _unique([tracks.names[k] for k in known])
    root = ElementTree.Element("robot", name=_valid(Path(path).stem))
    ElementTree.SubElement(root, "link", name=WORLD)
    sigmas = np.degrees(joints.axis_sigma_rad).tolist(), joints.origin_sigma_m.tolist()
    for k, name in zip(known, names, strict=True):
        tilt, shift = (_rounded(sigma[k]) for sigma in sigmas)
        about = {"query": k, "name": tracks.names[k], "axis_sigma_deg": tilt, "origin_sigma_m": shift}
        text = json.dumps(about).replace("--", r"-\u002d")  # two hyphens would end the comment
        root.append(ElementTree.Comment(f" {text} "))
        kind, at = joints.kind[k], rest[k].astype(np.float64)
        if kind == "static":
            _add_joint(root, f"{name}_joint", "fixed", (WORLD, name), at)
        else:
            turns, axis = kind == "revolute", joints.axis[k].astype(np.float64)
            child, origin = (f"{name}_hinge", joints.origin[k].astype(np.float64)) if turns else (name, at)
            limits = float(joints.q_min_seen[k]), float(joints.q_max_seen[k])
            _add_joint(root, f"{name}_joint", kind, (WORLD, child), origin, axis=axis, limits=limits)
            if turns:
                ElementTree.SubElement(root, "link", name=child)
                _add_joint(root, f"{name}_fixed", "fixed", (child, name), at - origin)
        visual = ElementTree.SubElement(ElementTree.SubElement(root, "link", name=name), "visual")
        geometry = ElementTree.SubElement(visual, "geometry")
        ElementTree.SubElement(geometry, "sphere", radius=_number(_SPHERE_M))
    ElementTree.indent(root)
    with whole_file(Path(path)) as partial:
        ElementTree.ElementTree(root).write(partial, encoding="utf-8", xml_declaration=True)
    left_out = tuple(tracks.names[k] for k in range(len(joints)) if k not in known)
    return UrdfNames(dict(zip(known, names, strict=True)), left_out)


def _add_joint(
    root: ElementTree.Element,
    name: str,
    kind: str,
    links: tuple[str, str],
    origin: Float[np.ndarray, "3"],
    *,
    axis: Float[np.ndarray, "3"] | None = None,
    limits: tuple[float, float] | None = None,
) -> None:
    joint = ElementTree.SubElement(root, "joint", name=name, type=kind)
    ElementTree.SubElement(joint, "parent", link=links[0])
    ElementTree.SubElement(joint, "child", link=links[1])
    ElementTree.SubElement(joint, "origin", xyz=_number(*origin), rpy="0 0 0")
    if axis is not None and limits is not None:
        ElementTree.SubElement(joint, "axis", xyz=_number(*(axis / np.linalg.norm(axis))))
        lower, upper, most = map(_number, (*limits, _UNLIMITED))
        ElementTree.SubElement(joint, "limit", lower=lower, upper=upper, effort=most, velocity=most)


def _number(*values: float | np.floating) -> str:
    return " ".join(f"{float(value):.9g}" for value in values)


def _rounded(value: float) -> float | None:
    """Three digits are enough of an uncertainty; None where it is not known."""
    return float(f"{value:.3g}") if np.isfinite(value) else None


def _valid(name: str) -> str:
    """A name of letters, digits and underscores, as ROS and simulators want it: accents are dropped."""
    plain = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    plain = re.sub(r"[^A-Za-z0-9]+", "_", plain).strip("_")
    return plain if plain[:1].isalpha() else f"query_{plain}".strip("_")


def _unique(names: list[str]) -> list[str]:
    """Valid names for links, so that neither they nor the names made of them clash."""
    taken, unique = {WORLD}, []
    for valid in map(_valid, names):
        tried = (valid if number == 1 else f"{valid}_{number}" for number in count(1))
        made = ([name, f"{name}_joint", f"{name}_hinge", f"{name}_fixed"] for name in tried)
        free = next(clashing for clashing in made if not taken & {*clashing})
        taken |= {*free}
        unique.append(free[0])
    return unique
