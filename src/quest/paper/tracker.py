"""Tracking as published: every frame's window is decoded anew, and a query keeps the slot that it took.

There are no joints and no alarms. A slot's answer is the lifted pixel of its coordinates; what it is called is decided
in the frame in which it is taken: whether there is an entity by its confidence, which label it has by its embedding.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from quest.errors import ConfigError, InputError
from quest.geometry import exact_product, invert, transform
from quest.geometry.letterbox import Letterbox
from quest.model.frames import FrameBatch, reference_of
from quest.model.precision import fast_bfloat16
from quest.model.weights import find_weights
from quest.paper.matching import assign_slots, slot_cost
from quest.paper.network import Decoded, PaperNetwork, is_paper, read_paper
from quest.track import Tracker
from quest.track import load as load_tracker
from quest.track.tracker import pick_device
from quest.types import LABELS, Clip, Query, State, Tracks

FOUND_ABOVE = 0.5
"""Confidence above which discovery takes a slot."""
PROMPT_ABOVE = 0.2
"""Confidence above which a label takes a slot; lower, because the user says that it is there."""
LOST_BELOW = 0.3
"""Confidence below which a query is lost."""
PATIENCE = 8
"""Frames in which a label or slot looks for its entity."""
_AT_A_TIME = 32
"""Frames whose windows are decoded together."""


class PaperTracker:
    """Follows entities through clips with the published network.

    Discovery takes a slot whose confidence is above ``found_above``, a label one above ``prompt_above``. A query keeps
    its slot; one that is not ``persistent`` goes on with whatever slot is nearest to its last answer.
    """

    name = "quest"

    def __init__(
        self,
        network: PaperNetwork,
        *,
        device: torch.device,
        weights_hash: str | None = None,
        found_above: float = FOUND_ABOVE,
        prompt_above: float = PROMPT_ABOVE,
        persistent: bool = True,
    ) -> None:
        self.network = network.to(device).eval()
        self.device = device
        self.weights_hash = weights_hash
        self.found_above = found_above
        self.prompt_above = prompt_above
        self.persistent = persistent

    def track(self, clip: Clip, queries: Sequence[Query] | None = None) -> Tracks:
        """Track a whole clip; the answer for a frame does not depend on later ones.

        Raises:
            InputError: a point query lies outside the clip, asks for an intent, or two queries have one name.
        """
        _check(clip, queries)
        slots = self._slots(clip)
        if queries is None:
            found = [(s, slots.label(0, s)) for s in slots.best(0) if slots.confidence[0, s] > self.found_above]
            chosen = [_Choice(f"{label} {k}", label, s, 0) for k, (s, label) in enumerate(found)]
        else:
            chosen = self._choose(slots, queries, Letterbox(clip.camera, self.network.config.encoder.image_size))
        return _tracks(clip, *((slots, chosen) if self.persistent else _nearest_anew(slots, chosen)))

    def _slots(self, clip: Clip) -> _Slots:
        """What all slots answer in every frame, each seen in a window of the newest T frames."""
        config, parts = self.network.config, list[_Slots]()
        box = Letterbox(clip.camera, config.encoder.image_size)
        before = torch.zeros(0, config.encoder.grid**2, config.encoder.width, device=self.device)
        reference: tuple[Tensor, Tensor, Tensor] | None = None
        with torch.inference_mode(), torch.autocast(self.device.type, torch.bfloat16, fast_bfloat16(self.device)):
            for start in range(0, len(clip), _AT_A_TIME):
                some = range(start, min(start + _AT_A_TIME, len(clip)))
                rgb, depth, pose = self._read(clip, some, box)
                lens = [[box.camera.fx, box.camera.fy, box.camera.cx, box.camera.cy]]
                intrinsics = torch.tensor(lens, dtype=torch.float32, device=self.device)
                if reference is None:
                    reference = pose[0], *reference_of(depth[:1], intrinsics, cell_px=config.cell_px)
                first, centre, scale = reference
                moved = exact_product(first, invert(pose)).float().to(self.device)
                known = torch.cat((before, self.network.encode(rgb).float()))
                last = self._windows(known, len(before))
                n = len(some)
                frames = FrameBatch(
                    known[len(before) :, None],
                    depth[:, None],
                    intrinsics.expand(n, -1),
                    moved[:, None],
                    centre.expand(n, -1),
                    scale.expand(n),
                )
                answers = self.network.answer([last], frames)
                metric = answers.point[:, 0].cpu().double() * scale.cpu() + centre.cpu()
                parts.append(
                    _Slots(
                        box.to_source(answers.uv[:, 0].cpu().numpy() * box.size),
                        transform(invert(first), metric).numpy(),
                        answers.logit[:, 0].sigmoid().cpu().numpy(),
                        answers.label_logits[:, 0].softmax(-1).cpu().numpy(),
                        (depth > 0).flatten(1).any(dim=1).cpu().numpy(),
                    )
                )
                before = known[max(0, len(known) - config.window + 1) :]
        return _Slots(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(_Slots)))

    def _read(self, clip: Clip, some: range, box: Letterbox) -> tuple[Tensor, Tensor, Tensor]:
        """Letterboxed colours and depth of some frames, zero where there is none, and their poses."""
        frames = [clip.frame(t) for t in some]
        rgb = np.stack([box.rgb(frame.rgb) for frame in frames])
        none = np.zeros((box.size, box.size), np.float32)
        depth_m = np.stack([none if frame.depth_m is None else box.depth(frame.depth_m) for frame in frames])
        pose = np.stack([np.asarray(frame.cam_from_world, np.float64) for frame in frames])
        # Poses stay on the CPU: not all devices have doubles.
        return torch.from_numpy(rgb).to(self.device), torch.from_numpy(depth_m).to(self.device), torch.from_numpy(pose)

    def _windows(self, features: Float[Tensor, "S N E"], earlier: int) -> Decoded:
        """The newest frame of the window that ends at every frame but the ``earlier`` ones.

        A clip's first frames have shorter windows.
        """
        t = self.network.config.window
        short = range(earlier, min(t - 1, len(features)))
        groups = [features[None, : end + 1] for end in short]
        if len(features) >= max(t, earlier + 1):
            begin = max(0, earlier - t + 1)
            groups.append(features[begin:].unfold(0, t, 1).permute(0, 3, 1, 2))
        decoded = [self.network.embed(group)[-1] for group in groups]
        return Decoded(*(torch.cat([getattr(d, name)[:, -1:] for d in decoded]) for name in ("embedding", "where")))

    def _choose(self, slots: _Slots, queries: Sequence[Query], box: Letterbox) -> list[_Choice]:
        """The slot that each query takes, and the frame from which on; labels take theirs before points do."""
        chosen: dict[int, _Choice] = {}
        for t in range(len(slots.confidence)):
            for k, query in enumerate(queries):
                if k in chosen or query.kind == "point" or t >= PATIENCE:
                    continue
                taken = {choice.slot for choice in chosen.values()}
                for s in slots.best(t):
                    label = slots.label(t, s)
                    if s not in taken and query.label in (None, label):
                        if slots.confidence[t, s] > self.prompt_above:
                            chosen[k] = _Choice(query.name or f"{label} {k}", label, s, t)
                        break
            due = [k for k, query in enumerate(queries) if query.kind == "point" and query.frame == t]
            if due:
                taken = {choice.slot for choice in chosen.values() if choice.slot is not None}
                found = _slots_at(slots, t, [queries[k] for k in due], sorted(taken), box)
                for k, slot in zip(due, found, strict=True):
                    chosen[k] = _Choice(queries[k].name or f"point {k}", queries[k].label, slot, t)
        unfound = [_Choice(query.name or query.label or query.kind, query.label, None, 0) for query in queries]
        return [chosen.get(k, unfound[k]) for k in range(len(queries))]


@dataclass(frozen=True)
class _Slots:
    """What K slots answer in every frame of a clip: source pixels, world points in metres, probabilities."""

    uv_px: Float[np.ndarray, "T K 2"]
    point_world: Float[np.ndarray, "T K 3"]
    confidence: Float[np.ndarray, "T K"]
    label_p: Float[np.ndarray, "T K L"]
    has_depth: Bool[np.ndarray, " T"]

    def best(self, frame: int) -> list[int]:
        """Slots, the most confident first."""
        return np.argsort(-self.confidence[frame], kind="stable").tolist()

    def label(self, frame: int, slot: int) -> str:
        return LABELS[int(self.label_p[frame, slot].argmax())]


@dataclass(frozen=True)
class _Choice:
    """The slot that a query follows from a frame on; None where it found no entity."""

    name: str
    label: str | None
    slot: int | None
    frame: int


def load(
    name: str | Path = "quest-s16",
    *,
    device: str = "auto",
    monitor: bool | str | Path = True,
    engine: str | Path = "torch",
) -> Tracker | PaperTracker:
    """The tracker of any weights: ours (see :func:`quest.track.load`), or the published one where they are its.

    Arguments and errors are those of :func:`quest.track.load`, but PyTorch alone runs the published network.

    Raises:
        ConfigError: another engine for the published network.
        WeightsError: no such weights, or they cannot be read.
    """
    path = find_weights(name)
    if not is_paper(path):
        return load_tracker(name, device=device, monitor=monitor, engine=engine)
    if engine != "torch":
        raise ConfigError(f"engine {str(engine)!r}: PyTorch alone runs the published network; leave it out")
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    return PaperTracker(read_paper(path).network, device=pick_device(device), weights_hash=sha256)


def _check(clip: Clip, queries: Sequence[Query] | None) -> None:
    names = [query.name for query in queries or () if query.name]
    if len(set(names)) < len(names):
        raise InputError(f"queries: expected a name each, got {', '.join(names)}; choose other names")
    for query in queries or ():
        if query.words is not None:
            raise InputError(f"text {query.words!r}: the published network finds no doors; use weights of the finder")
        if query.intent is not None:
            raise InputError(
                f"query {query.name or query.kind!r}: the published network cannot tell what to {query.intent}; omit "
                "the intent or use weights of the finder"
            )
        if query.frame >= len(clip):
            raise InputError(f"clip {clip.name!r}: query at frame {query.frame}, but the clip has {len(clip)} frames")
        x, y = query.uv_px or (0, 0)
        if not (0 <= x <= clip.camera.width and 0 <= y <= clip.camera.height):
            raise InputError(
                f"query {query.name!r}: expected a pixel within {clip.camera.width} x {clip.camera.height}, "
                f"got ({x:.1f}, {y:.1f})"
            )


def _slots_at(slots: _Slots, t: int, queries: Sequence[Query], taken: Sequence[int], box: Letterbox) -> list[int]:
    """The slots that answer for points in a frame, at the cost that training matches them by; no two share one.

    Slots that answer for something already are taken again where there are not enough others.
    """
    label_p = torch.from_numpy(slots.label_p[t])
    alike = [torch.ones(len(label_p)) if q.label is None else label_p[:, LABELS.index(q.label)] for q in queries]
    probability = torch.from_numpy(slots.confidence[t])[:, None] * torch.stack(alike, dim=-1)
    target, uv = (
        torch.from_numpy(box.to_canvas(uv_px) / box.size).float()[None, None]
        for uv_px in (np.array([q.uv_px for q in queries], np.float32), slots.uv_px[t])
    )
    wanted = torch.ones(1, len(queries), dtype=torch.bool)
    cost = slot_cost(uv, probability[None, None], target, wanted[None])
    # More than all that is free can cost together, so that what is taken comes last.
    cost[..., list(taken)] += 2 * len(queries) * (1 + float(cost.abs().max()))
    slot, found = assign_slots(cost, wanted)
    return torch.where(found, slot, cost.argmin(dim=-1))[0].tolist()


def _nearest_anew(slots: _Slots, chosen: Sequence[_Choice]) -> tuple[_Slots, list[_Choice]]:
    """A slot for every choice that answers in each frame what is nearest to the choice's last answer."""
    index = np.zeros((len(slots.confidence), len(chosen)), np.int64)
    for k, choice in enumerate(chosen):
        if choice.slot is not None:
            index[: choice.frame + 1, k] = choice.slot
            for t in range(choice.frame + 1, len(index)):
                last = slots.uv_px[t - 1, index[t - 1, k]]
                index[t, k] = np.linalg.norm(slots.uv_px[t] - last, axis=-1).argmin()
    frames = np.arange(len(index))[:, None]
    names = ("uv_px", "point_world", "confidence", "label_p")
    taken = replace(slots, **{name: getattr(slots, name)[frames, index] for name in names})
    return taken, [choice if choice.slot is None else replace(choice, slot=k) for k, choice in enumerate(chosen)]


def _tracks(clip: Clip, slots: _Slots, chosen: Sequence[_Choice]) -> Tracks:
    """The answers of the chosen slots.

    Where a frame has depth, but not at a slot's pixel, its last point is held and it does not count as seen.
    """
    t, k = len(clip), len(chosen)
    uv = np.full((t, k, 2), np.nan, np.float32)
    point = np.full((t, k, 3), np.nan, np.float32)
    confidence, visible = np.zeros((t, k), np.float32), np.zeros((t, k), bool)
    state = np.full((t, k), State.LOST.value, dtype="<U8")
    for i, choice in enumerate(chosen):
        if choice.slot is None:
            continue
        after, frames = slice(choice.frame, None), np.arange(t - choice.frame)
        uv[after, i], confidence[after, i] = slots.uv_px[after, choice.slot], slots.confidence[after, choice.slot]
        place = slots.point_world[after, choice.slot]
        known = np.isfinite(place).all(axis=-1)
        last = np.maximum.accumulate(np.where(known, frames, -1))
        held = ~known & (last >= 0) & slots.has_depth[after]
        point[after, i] = np.where(held[:, None], place[np.maximum(last, 0)], place)
        inside = ((uv[after, i] >= 0) & (uv[after, i] <= (clip.camera.width, clip.camera.height))).all(axis=-1)
        sure = confidence[after, i]
        visible[after, i] = (sure > 0.5) & inside & ~held
        seen = np.where(visible[after, i], State.TRACKING.value, State.HELD.value)
        state[after, i] = np.where(sure < LOST_BELOW, State.LOST.value, seen)
    flags = [] if slots.has_depth.all() else ["depth missing in some frames: world points there are NaN"]
    flags += [f"query {c.name!r} found no entity: lost in every frame" for c in chosen if c.slot is None]
    names, labels = tuple(choice.name for choice in chosen), tuple(choice.label for choice in chosen)
    return Tracks(names, labels, uv, point, confidence, visible, state, clip.stamp_s, tuple(flags))
