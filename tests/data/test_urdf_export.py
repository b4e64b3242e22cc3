"""Joints as a URDF: other programs load it, and move each entity where its joint does."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import quest
from quest.data.cut import cut_clip
from quest.data.urdf_export import write_urdf
from quest.errors import InputError
from quest.filter.joints import Joint, JointKind
from quest.geometry.vectors import perpendicular
from quest.types import Joints, Query, State, Tracks

FRAMES = 12


def make_joint(kind: JointKind, rng: np.random.Generator) -> Joint:
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    rest = rng.normal(size=3)
    origin = rest + 0.4 * perpendicular(axis)[:, 0] if kind is JointKind.REVOLUTE else rest
    size = 3 if kind is JointKind.STATIC else 4
    return Joint(kind, axis, origin, rest, -0.2, 2.8, 1e-4 * np.eye(size))


def make_tracks(joints: list[Joint], names: list[str]) -> tuple[Tracks, np.ndarray]:
    """Tracks of what joints move, and the true points; the tracks miss some frames, are wrong and lost in others."""
    k = len(joints)
    q = np.linspace(-0.2, 2.8, FRAMES)
    point = np.stack([joint.at(q) for joint in joints], axis=1)
    seen = point.copy()
    seen[2] = np.nan
    seen[5] += 0.5
    moves = np.array([joint.kind is not JointKind.STATIC for joint in joints])
    state = np.full((FRAMES, k), State.TRACKING.value, dtype="<U8")
    state[5] = State.LOST.value
    found = Joints(
        kind=tuple(joint.kind.value for joint in joints),
        axis=np.where(moves[:, None], [joint.axis for joint in joints], np.nan).astype(np.float32),
        origin=np.array([joint.origin for joint in joints], np.float32),
        q_min_seen=np.where(moves, -0.2, np.nan).astype(np.float32),
        q_max_seen=np.where(moves, 2.8, np.nan).astype(np.float32),
        q=np.where(moves & (np.arange(FRAMES) != 2)[:, None], q[:, None], np.nan).astype(np.float32),
        covariance=np.array([joint.line_covariance for joint in joints], np.float32),
    )
    tracks = Tracks(
        names=tuple(names),
        labels=(None,) * k,
        uv_px=np.zeros((FRAMES, k, 2), np.float32),
        point_world=seen.astype(np.float32),
        confidence=np.ones((FRAMES, k), np.float32),
        visible=np.ones((FRAMES, k), bool),
        state=state,
        stamp_s=np.arange(FRAMES) / 30.0,
        joints=found,
    )
    return tracks, point


def replayed(path: Path, link: str, q: np.ndarray) -> np.ndarray:
    """Where another program brings a link at each coordinate of its joint."""
    robot = pytest.importorskip("yourdfpy").URDF.load(str(path))
    places = []
    for value in q:
        if f"{link}_joint" in robot.actuated_joint_names:
            robot.update_cfg({f"{link}_joint": float(value)})
        places.append(robot.get_transform(link, "world")[:3, 3])
    return np.array(places)


@pytest.mark.parametrize("kind", list(JointKind))
def test_other_programs_move_the_entity_where_its_joint_does(kind: JointKind, tmp_path: Path):
    for seed in (0, 1):
        tracks, point = make_tracks([make_joint(kind, np.random.default_rng(seed))], ["lid"])
        path = tmp_path / str(seed) / "lid.urdf"
        names = write_urdf(tracks, path)
        assert (names.link, names.left_out) == ({0: "lid"}, ())
        np.testing.assert_allclose(replayed(path, "lid", np.linspace(-0.2, 2.8, FRAMES)), point[:, 0], atol=1e-4)
        assert list(path.parent.iterdir()) == [path]


def test_limits_axes_and_uncertainty(tmp_path: Path):
    rng = np.random.default_rng(3)
    joints = [make_joint(kind, rng) for kind in JointKind]
    tracks, _ = make_tracks(joints, ["still", "slides", "turns"])
    write_urdf(tracks, tmp_path / "mine.urdf")
    yourdfpy = pytest.importorskip("yourdfpy")
    robot = yourdfpy.URDF.load(str(tmp_path / "mine.urdf"))
    assert robot.validate()
    assert robot.base_link == "world"
    assert robot.actuated_joint_names == ["slides_joint", "turns_joint"]
    for name, joint in zip(("slides_joint", "turns_joint"), joints[1:], strict=True):
        read = robot.joint_map[name]
        np.testing.assert_allclose(read.axis, joint.axis, atol=1e-6)
        np.testing.assert_allclose((read.limit.lower, read.limit.upper), (-0.2, 2.8), atol=1e-6)
    text = (tmp_path / "mine.urdf").read_text(encoding="utf-8")
    assert '"axis_sigma_deg": null, "origin_sigma_m": 0.01' in text
    assert text.count(f'"axis_sigma_deg": {np.degrees(0.01):.3g}, "origin_sigma_m": 0.01') == 2


def test_names_are_valid_unique_and_escaped(tmp_path: Path):
    rng = np.random.default_rng(4)
    given = ["handle 1", "handle_1", "größer -- <a&b>", "---", "", "3", "world", "lid", "lid_joint", "\x00\ud800門"]
    tracks, _ = make_tracks([make_joint(JointKind.REVOLUTE, rng) for _ in given], given)
    names = write_urdf(tracks, tmp_path / "1 mine.urdf")
    links = list(names.link.values())
    assert links == [
        *["handle_1", "handle_1_2", "groer_a_b", "query", "query_2", "query_3", "world_2", "lid", "lid_joint_2"],
        "query_4",
    ]
    root = ElementTree.parse(tmp_path / "1 mine.urdf").getroot()
    assert root.get("name") == "query_1_mine"
    named = [element.get("name") for element in root]
    assert len(set(named)) == len(named)
    pytest.importorskip("yourdfpy").URDF.load(str(tmp_path / "1 mine.urdf"))


def test_unknown_joints_are_left_out_and_named(tmp_path: Path):
    rng = np.random.default_rng(5)
    tracks, _ = make_tracks([make_joint(JointKind.PRISMATIC, rng)] * 2, ["drawer", "nothing"])
    assert tracks.joints is not None
    kind = (tracks.joints.kind[0], "unknown")
    names = write_urdf(replace(tracks, joints=replace(tracks.joints, kind=kind)), tmp_path / "a.urdf")
    assert (names.link, names.left_out) == ({0: "drawer"}, ("nothing",))
    with pytest.raises(InputError, match="have no joints"):
        write_urdf(replace(tracks, joints=None), tmp_path / "b.urdf")
    assert not (tmp_path / "b.urdf").exists()


def test_our_own_reader_takes_it(tmp_path: Path):
    urdf = pytest.importorskip("quest.sim.urdf")
    joints = [make_joint(kind, np.random.default_rng(6)) for kind in JointKind]
    write_urdf(make_tracks(joints, ["still", "slides", "turns"])[0], tmp_path / "a.urdf")
    read = urdf.read_urdf(tmp_path / "a.urdf")
    assert [joint.kind for joint in read.joints] == ["fixed", "prismatic", "revolute", "fixed"]
    assert [len(visuals) for visuals in read.links.values()].count(1) == 3


@pytest.mark.slow
def test_the_packaged_clip(tmp_path: Path):
    clip = cut_clip(quest.read("sample"), slice(0, 36))
    tracks = quest.load(device="cpu").track(clip, [Query.point(0, 450, 228, name="handle")])
    joints = tracks.joints
    assert joints is not None
    assert joints.kind[0] in ("revolute", "prismatic")
    write_urdf(tracks, tmp_path / "sample.urdf")
    known = np.isfinite(joints.q[:, 0])
    q = joints.q[known, 0].astype(np.float64)
    fields = joints.rest(tracks.point_world, tracks.state), joints.axis, joints.origin
    rest, axis, origin = (values[0].astype(np.float64) for values in fields)
    origin = origin + axis * (axis @ (rest - origin))  # the axis' point nearest to it
    motion = Joint(JointKind(joints.kind[0]), axis, origin, rest, 0.0, 1.0, np.eye(4))
    places = replayed(tmp_path / "sample.urdf", "handle", q)
    np.testing.assert_allclose(places, motion.at(q), atol=1e-4)
    assert np.median(np.linalg.norm(places - tracks.point_world[known, 0], axis=-1)) < 0.02
