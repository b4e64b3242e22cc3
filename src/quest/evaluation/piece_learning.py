"""Teach a network which pieces that stand out of planes are handles and knobs, and how far to trust its map's peaks.

Takes must be of training objects that the map did not learn from: of those that it did, it knows every handle, and what
is learned here is how far it can be trusted where it does not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from quest.baselines.memory import remember_frames
from quest.errors import ConfigError
from quest.evaluation.selection import Chosen
from quest.geometry import transform
from quest.model.discovery import FOUND_WITHIN, match_peaks, sight
from quest.model.network import QuestNetwork
from quest.model.observation import FrameBatch
from quest.model.pieces import PieceHead
from quest.track import Tracker
from quest.track.finder import Finder
from quest.types import GRIPS, LABELS, Camera, Frame, Take

_STEPS = 500
_RATE = 1e-2
_DECAY = 0.1
_AS_NEAR = 0.03
"""Pieces that are so much farther from an entity than the nearest one, normalised units, are it too: one handle may
stand out of two planes."""
_RIDGE = 1e-3


@dataclass(frozen=True)
class Learned:
    """What came of it."""

    network: QuestNetwork
    """The network with a head that ranks pieces; everything else is as it was."""
    pieces: int
    """How many were learned from."""
    right: int
    """How many of them were a handle or knob."""
    peaks: int
    """How many peaks of the map were learned from."""
    loss: float
    """Cross-entropy of the pieces at the end."""


@dataclass(frozen=True)
class _Lesson:
    """One frame: inputs and classes of its pieces; scores, groups and whether they are right of its peaks."""

    inputs: Float[Tensor, "P F"]
    kind: Int[Tensor, " P"]
    score: Float[Tensor, " K"]
    group: Int[Tensor, " K"]
    right: Float[Tensor, " K"]


@dataclass(frozen=True)
class _Entities:
    """What is seen in a frame: points in camera axes, labels, and metres per normalised unit."""

    point_m: Float[Tensor, "E 3"]
    label: Int[Tensor, " E"]
    half_diagonal_m: float


def learn_pieces(
    tracker: Tracker, takes: Chosen, *, seed: int = 0, progress: Callable[[str, int, int], None] = lambda *_: None
) -> Learned:
    """Teach a network to rank pieces by the first frames of takes, each view of them; a first view also without depth.

    Args:
        tracker: with the network and the settings of discovery.
        takes: stores with takes of training objects, or of your own, which are in no part of the split.
        seed: of the head's first weights.
        progress: told of every take before it is read: its name, how many come before it, how many there are.

    Raises:
        ConfigError: a take is not of a training object, or no handle or knob stands out in any of them.
    """
    wrong = [name for _, chosen in takes for name, part in chosen.items() if part not in ("train", "unlisted")]
    if wrong:
        raise ConfigError(f"pieces: expected takes of training objects only, got {wrong[:3]}")
    names = [(store, name) for store, chosen in takes for name in chosen]
    remember_frames(tracker.network, capacity=4)  # the same picture with and without depth
    lessons: list[_Lesson] = []
    for done, (store, name) in enumerate(names):
        progress(name, done, len(names))
        lessons += _lessons(tracker, store.read(name, frames=slice(0, 1)))
    if not any(bool((lesson.kind > 0).any()) for lesson in lessons):
        raise ConfigError("pieces: in none of these takes a handle or knob stands out of a plane")
    torch.manual_seed(seed)
    head = PieceHead()
    loss = _fit_pieces(head, lessons)
    _fit_trust(head, lessons)
    network = QuestNetwork(replace(tracker.network.config, pieces=True))
    own = {f"affordance_pieces.{name}": tensor for name, tensor in head.state_dict().items()}
    network.load_state_dict(tracker.network.state_dict() | own)
    kinds = torch.cat([lesson.kind for lesson in lessons])
    peaks = sum(len(lesson.score) for lesson in lessons)
    return Learned(network.eval(), len(kinds), int((kinds > 0).sum()), peaks, loss)


def _lessons(tracker: Tracker, take: Take) -> Iterator[_Lesson]:
    """What the first frame of every view teaches."""
    for view, truth in enumerate(take.views):
        frame, camera = truth.clip.frame(0), truth.clip.camera
        seen = [int(e) for e in take.tracked if truth.visible[0, e]]
        true_m = transform(
            torch.from_numpy(truth.clip.cam_from_world[0]).float(), torch.from_numpy(take.point_world[0])
        )
        label = torch.tensor([LABELS.index(take.info.entities[e].label) for e in seen], dtype=torch.long)
        entities = _Entities(true_m[seen], label, take.info.half_diagonal_m)
        full = _prepared(tracker, camera, frame)
        yield _lesson(tracker, full, full, entities)
        if view == 0:
            yield _lesson(tracker, _prepared(tracker, camera, replace(frame, depth_m=None)), full, entities)


def _prepared(tracker: Tracker, camera: Camera, frame: Frame) -> FrameBatch:
    with torch.no_grad():
        finder = Finder(tracker.network, camera, device=tracker.device)
        return finder.prepare(frame.rgb, frame.depth_m)


def _lesson(tracker: Tracker, frames: FrameBatch, full: FrameBatch, entities: _Entities) -> _Lesson:
    """What one frame teaches.

    Args:
        tracker: whose network looks at it.
        frames: the frame.
        full: the same with depth, by which places are judged.
        entities: what is seen in it.
    """
    network, radius_cells = tracker.network, tracker.config.slot_radius_cells
    with torch.no_grad():
        sighted = sight(network, frames, None, radius_cells=radius_cells)
    pieces_m = _lifted(full, sighted.pieces.uv_px)
    kind = torch.zeros(len(pieces_m), dtype=torch.long)
    for number, name in enumerate(GRIPS, start=1):
        gap = torch.cdist(pieces_m, entities.point_m[entities.label == LABELS.index(name)]) / entities.half_diagonal_m
        if gap.numel():
            gap = gap.nan_to_num(torch.inf)
            kind[((gap < FOUND_WITHIN) & (gap <= gap.amin(dim=0) + _AS_NEAR)).any(dim=1)] = number
    apart = sighted.peaks.apart()[: network.config.slots]
    peaks = sighted.peaks.peaks.select(apart)
    peaks_m = _lifted(full, peaks.uv * network.config.encoder.image_size)
    found = match_peaks(
        peaks_m, peaks.label.cpu(), entities.point_m, entities.label, half_diagonal_m=entities.half_diagonal_m
    )
    known = torch.isfinite(peaks_m).all(dim=1)  # without a place nothing is right, nor wrong
    return _Lesson(
        sighted.pieces.inputs.cpu(),
        kind,
        peaks.logit.float().cpu()[known],
        sighted.group[apart].cpu()[known],
        (found >= 0).float()[known],
    )


def _lifted(frames: FrameBatch, uv_px: Float[Tensor, "K 2"]) -> Float[Tensor, "K 3"]:
    """What is seen at pixels: camera axes, metres."""
    return frames.to_camera(frames.near_point_at(uv_px[None, None].to(frames.depth_m)))[0, 0].cpu()


def _fit_pieces(head: PieceHead, lessons: list[_Lesson]) -> float:
    """Learn the classes of all pieces; returns the last loss."""
    inputs, kind = torch.cat([x.inputs for x in lessons]), torch.cat([x.kind for x in lessons])
    head.mean.copy_(inputs.mean(dim=0))
    head.spread.copy_(inputs.std(dim=0) + 1e-3)
    optimiser = torch.optim.AdamW(head.mlp.parameters(), lr=_RATE, weight_decay=_DECAY)
    schedule = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, 0.0, _STEPS)
    loss = inputs.new_zeros(())
    for _ in range(_STEPS):
        loss = F.cross_entropy(head.classify(inputs), kind)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    return float(loss.detach())


def _fit_trust(head: PieceHead, lessons: list[_Lesson]) -> None:
    """Learn, for every group of peaks, log odds that are linear in their score (Platt, 1999)."""
    score, group = torch.cat([x.score for x in lessons]), torch.cat([x.group for x in lessons])
    right = torch.cat([x.right for x in lessons])
    optimiser = torch.optim.LBFGS([head.gain, head.bias], max_iter=200, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimiser.zero_grad()
        value = F.binary_cross_entropy_with_logits(head.trust(score, group), right)
        value = value + _RIDGE * (head.gain - 1).square().sum() + _RIDGE * head.bias.square().sum()
        value.backward()
        return value

    optimiser.step(loss)
