"""Clips whose answers are known: what the tracker says of them with the weights that ship, and how good it is.

A clip is one line of :data:`CLIPS`, with its truth beside it. The answers and signals that were recorded lie in
``NAME/answers.npz``, how far off they were in ``NAME/figures.json``. ``python -m tests.golden`` makes these files.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

import quest
from quest import Clip, Query, Tracker, Tracks
from quest.data.cut import cut_clip
from quest.data.sample import sample_folder

HERE = Path(__file__).parent
WEIGHTS = "quest-s16"
"""Others only find other entities; all are followed alike."""


@dataclass(frozen=True)
class GoldenClip:
    """A clip and how it is followed."""

    name: str
    strides: tuple[int, ...] = (1, 3)
    """Every so many of them: answers must not hang on the frame rate."""
    take: tuple[str, int] | None = None
    """Simulated object and seed, of suite occlusion; None for a packaged clip, by its name."""
    entities: tuple[str, ...] = ()
    """What is asked for by its pixel in the first frame; the first one is hidden meanwhile. If none, what is found."""

    @property
    def folder(self) -> Path:
        """Where its golden files lie."""
        return HERE / self.name

    def read(self) -> Clip:
        """All its frames."""
        if self.take is None:
            return quest.read(self.name)
        return replace(quest.read(self.folder), depth_m=read_depth(self.folder))

    def truth(self) -> Truth:
        """What is true of it."""
        return Truth.of_sample(self.name) if self.take is None else Truth.read(self.folder)

    def queries(self, truth: Truth) -> list[Query] | None:
        """The entities by their pixels in the first frame; None to follow what is found."""
        if not self.entities:
            return None
        at = {name: truth.uv_px[0, truth.index(name)].tolist() for name in self.entities}
        return [Query.point(0, x, y, name=name) for name, (x, y) in at.items()]


@dataclass(frozen=True)
class Truth:
    """What is true of some entities of a clip."""

    name: np.ndarray
    """[E] of text."""
    uv_px: np.ndarray
    """[T, E, 2], also where hidden."""
    visible: np.ndarray
    """[T, E]"""
    point_world: np.ndarray
    """[T, E, 3], metres."""
    joint: np.ndarray
    """[E]: ``prismatic``, ``revolute``, or ``static`` where nothing moved it."""
    axis: np.ndarray
    """[E, 3]: direction of the joint in the world."""
    half_diagonal_m: np.ndarray
    """[]: the unit of normalised distances."""

    @classmethod
    def read(cls, folder: Path) -> Truth:
        """The truth beside a clip."""
        with np.load(folder / "truth.npz") as arrays:
            return cls(**arrays)

    @classmethod
    def of_sample(cls, name: str) -> Truth:
        """The truth of a packaged clip."""
        known = json.loads((sample_folder(name) / "truth.json").read_text(encoding="utf-8"))
        entities = known["entities"]
        uv_px = np.array([entity["uv_px"] for entity in entities], np.float32).swapaxes(0, 1)
        visible = np.zeros(uv_px.shape[:2], bool)
        for e, entity in enumerate(entities):
            for first, end in entity["visible_frames"]:
                visible[first:end, e] = True
        return cls(
            name=np.array([entity["name"] for entity in entities], dtype=np.str_),
            uv_px=uv_px,
            visible=visible,
            point_world=np.array([entity["point_world_m"] for entity in entities], np.float32).swapaxes(0, 1),
            joint=np.array([entity["joint"]["kind"] if entity["moves"] else "static" for entity in entities], np.str_),
            axis=np.array([entity["joint"]["axis"] for entity in entities], np.float32),
            half_diagonal_m=np.array(known["half_diagonal_m"], np.float32),
        )

    def write(self, folder: Path) -> None:
        """Put it beside a clip."""
        np.savez_compressed(folder / "truth.npz", **asdict(self))

    def index(self, name: str) -> int:
        """Which of the entities has a name."""
        return list(self.name).index(name)

    def followed(self, tracks: Tracks) -> list[int]:
        """Which entity each query is to follow: the nearest one in the first frame that has an answer."""
        first = np.isfinite(tracks.uv_px).all(axis=-1).argmax(axis=0)
        return [int(np.linalg.norm(self.uv_px[0] - tracks.uv_px[t, k], axis=-1).argmin()) for k, t in enumerate(first)]


@dataclass(frozen=True)
class Figures:
    """How good the answer to one query is."""

    median_px: float
    """Over frames in which the entity is seen."""
    median_mm: float
    """Over all frames, seen or hidden."""
    end_mm: float
    """In the last frame."""
    identity: bool
    """Whether, in the last frame, no other entity is nearer to the answer."""
    joint: str
    """Kind of the joint at the end."""
    axis_deg: float | None
    """Angle to the true axis; None where there is none, or where the kind is another."""


CLIPS = (
    GoldenClip("sample", strides=(2,)),
    GoldenClip("sample-alarm", strides=(2,)),
    GoldenClip("drawer", take=("night_stand-104010", 1), entities=("link_1/knob", "link_0/knob")),
    GoldenClip("sideboard", take=("sideboard-104012", 1), entities=("link_1/knob", "link_0/knob")),
)


def write_depth(folder: Path, depth_m: np.ndarray) -> None:
    """Millimetres as differences from frame to frame, which are few where the camera stands still."""
    mm = np.rint(depth_m * 1e3).astype(np.uint16)
    np.savez_compressed(folder / "depth.npz", change_mm=np.diff(mm, axis=0, prepend=np.zeros_like(mm[:1])))


def read_depth(folder: Path) -> np.ndarray:
    """Depth in metres, [T, H, W]."""
    with np.load(folder / "depth.npz") as arrays:
        return np.cumsum(arrays["change_mm"], axis=0, dtype=np.uint16) * np.float32(1e-3)


def follow(tracker: Tracker, clip: Clip, queries: list[Query] | None, stride: int) -> Tracks:
    """Answers to every query of a clip."""
    return tracker.track(cut_clip(clip, slice(None, None, stride)), queries)


def judge(tracks: Tracks, truth: Truth, stride: int) -> dict[str, Figures]:
    """How good the answers to all queries are."""
    assert tracks.joints is not None
    figures = {}
    for k, e in enumerate(truth.followed(tracks)):
        kind, axis = tracks.joints.kind[k], None
        off_px = np.linalg.norm(tracks.uv_px[:, k] - truth.uv_px[::stride, e], axis=-1)
        off_m = np.linalg.norm(tracks.point_world[:, k, None] - truth.point_world[::stride], axis=-1)
        if kind == truth.joint[e] and kind != "static":
            cosine = abs(float(tracks.joints.axis[k] @ truth.axis[e]))
            axis = round(float(np.degrees(np.arccos(min(cosine, 1.0)))), 2)
        figures[f"{tracks.names[k]} on {truth.name[e]}"] = Figures(
            median_px=round(float(np.median(off_px[truth.visible[::stride, e]])), 3),
            median_mm=round(1e3 * float(np.median(off_m[:, e])), 2),
            end_mm=round(1e3 * float(off_m[-1, e]), 2),
            identity=bool(off_m[-1].argmin() == e),
            joint=kind,
            axis_deg=axis,
        )
    return figures


RECORDED = ("uv_px", "point_world", "confidence", "visible", "lost_p", "alarm")


def arrays_of(tracks: Tracks) -> dict[str, np.ndarray]:
    """What is recorded of a run."""
    assert tracks.joints is not None
    return {
        "name": np.array(tracks.names, dtype=np.str_),
        **{name: np.asarray(getattr(tracks, name)) for name in RECORDED},
        "joint": np.array(tracks.joints.kind, dtype=np.str_),
        "axis": tracks.joints.axis,
    }


def read_answers(clip: GoldenClip, stride: int) -> list[dict[str, np.ndarray]]:
    """What was recorded of a run, on each kind of processor whose rounding leads elsewhere.

    Where an entity is found again at one of two places that are as likely as each other, the last digit decides.
    """
    prefix, found = f"{stride}/", []
    for path in sorted(clip.folder.glob("answers*.npz")):
        with np.load(path) as arrays:
            found.append({name.removeprefix(prefix): arrays[name] for name in arrays.files if name.startswith(prefix)})
    return found


def read_figures(clip: GoldenClip, stride: int) -> dict[str, Figures]:
    """How good a run was when the figures were last written."""
    rows = json.loads((clip.folder / "figures.json").read_text(encoding="utf-8"))[str(stride)]
    return {name: Figures(**row) for name, row in rows.items()}


def load() -> Tracker:
    """The tracker of shipped weights on the CPU."""
    return quest.load(WEIGHTS, device="cpu")
