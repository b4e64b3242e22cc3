"""The step function of tracking: one frame in, one answer per query out, in bounded time and memory."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor

from quest.data.letterbox import Letterbox
from quest.errors import InputError
from quest.geometry import invert, transform
from quest.model.decoder import Anchor, HeatmapHead, Prediction
from quest.model.discovery import Peaks, find_peaks
from quest.model.network import UNKNOWN_LABEL, QuestNetwork
from quest.model.observation import FrameBatch, Observation, cell_centres, cell_depth, reference_of
from quest.track.belief import Belief, update
from quest.track.evidence import Evidence
from quest.track.grounded import Ground, joint_rows
from quest.track.lifting import lift_near
from quest.track.settings import TrackerConfig
from quest.track.state import StreamState
from quest.types import LABELS, Camera, Frame, Query, State

_LOST_BELOW = 0.3
_LEAP = 0.12
_AFTER_ALL = 0.2


@dataclass
class _Bound:
    """A query that has found its entity."""

    query: int
    name: str
    label: str | None
    slot: int | None
    ground: Ground
    belief: Belief | None = None
    last_seen: Tensor | None = None


class Stream:
    """Tracks queries through frames that come one by one; made by :meth:`quest.track.Tracker.stream`.

    The memory is a ring of T observed frames, one anchor and one belief per query.

    Args:
        network: trained network in evaluation mode.
        config: settings of tracking.
        camera: intrinsics of the frames.
        queries: what to follow; None discovers entities in the first frame.
        device: where the network runs.
        autocast: whether the network computes in bfloat16.

    Raises:
        InputError: a point query lies outside the image.
    """

    def __init__(
        self,
        network: QuestNetwork,
        config: TrackerConfig,
        camera: Camera,
        queries: Sequence[Query] | None,
        *,
        device: torch.device,
        autocast: bool,
    ) -> None:
        self._network = network
        self._config = config
        self._letterbox = Letterbox(camera, network.config.encoder.image_size)
        self._discover_all = queries is None
        self._waiting = list(enumerate(queries or ()))
        for _, query in self._waiting:
            _check_pixel(query, camera)
        self._device = device
        self._autocast = autocast
        self._ring: deque[Observation] = deque(maxlen=network.config.window)
        self._reference: tuple[Tensor, Tensor, Tensor] | None = None
        self._reference_has_depth = False
        self._bound: list[_Bound] = []
        self._anchor: Anchor | None = None
        self._t = 0

    @property
    def unbound(self) -> tuple[Query, ...]:
        """Queries that have not found their entity, and point queries whose frame has not come."""
        return tuple(query for _, query in self._waiting)

    def step(
        self,
        rgb: UInt8[np.ndarray, "H W 3"],
        depth_m: Float32[np.ndarray, "H W"] | None,
        stamp_s: float,
        cam_from_world: Float[np.ndarray, "4 4"] | None = None,
    ) -> StreamState:
        """Track the next frame.

        Args:
            rgb: colours.
            depth_m: metres along +z; 0 or NaN where missing, None without depth.
            stamp_s: time in seconds.
            cam_from_world: pose of the camera; the world is the camera if None.

        Raises:
            InputError: the frame does not have the camera's size or type, or the pose is no 4 x 4 matrix.
        """
        self._check(rgb, depth_m, cam_from_world)
        with torch.inference_mode(), torch.autocast(self._device.type, torch.bfloat16, enabled=self._autocast):
            frames = self._frame_batch(rgb, depth_m, np.eye(4) if cam_from_world is None else cam_from_world)
            observed = self._network.observe(frames)
            while len(self._ring) < self._network.config.window - 1:
                self._ring.append(observed)
            self._ring.append(observed)
            self._bind(observed, frames)
            state = self._answer(frames, stamp_s, bool((frames.depth_m > 0).any()))
        self._t += 1
        return state

    def candidates(self, frame: Frame) -> Peaks:
        """What discovery would choose from in a frame, whatever its score; nothing is bound.

        Raises:
            InputError: the frame does not have the camera's size or type, or the pose is no 4 x 4 matrix.
        """
        self._check(frame.rgb, frame.depth_m, frame.cam_from_world)
        with torch.inference_mode(), torch.autocast(self._device.type, torch.bfloat16, enabled=self._autocast):
            frames = self._frame_batch(frame.rgb, frame.depth_m, frame.cam_from_world)
            observed = self._network.observe(frames)
            return find_peaks(self._network, observed, radius_cells=self._config.slot_radius_cells)

    def _check(self, rgb: np.ndarray, depth_m: np.ndarray | None, cam_from_world: np.ndarray | None) -> None:
        camera = self._letterbox.source
        expected = (camera.height, camera.width, 3)
        if rgb.shape != expected or rgb.dtype != np.uint8:
            raise InputError(f"frame {self._t}: expected colours {expected} of uint8, got {rgb.shape} of {rgb.dtype}")
        if depth_m is not None and (depth_m.shape != expected[:2] or not np.issubdtype(depth_m.dtype, np.floating)):
            raise InputError(
                f"frame {self._t}: expected depth {expected[:2]} in metres as float, got {depth_m.shape} of "
                f"{depth_m.dtype}; multiply raw units by their size in metres"
            )
        pose = np.eye(4) if cam_from_world is None else np.asarray(cam_from_world)
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            raise InputError(f"frame {self._t}: expected a finite 4 x 4 cam_from_world, got {pose.tolist()}")

    def _frame_batch(self, rgb: np.ndarray, depth_m: np.ndarray | None, cam_from_world: np.ndarray) -> FrameBatch:
        network, box = self._network, self._letterbox
        size = network.config.encoder.image_size
        image = torch.from_numpy(np.ascontiguousarray(box.rgb(rgb))).to(self._device)
        raw = np.zeros((size, size), np.float32) if depth_m is None else box.depth(depth_m)
        depth = torch.from_numpy(raw).to(self._device)[None]
        cells = cell_depth(depth, network.config.cell_px)
        camera = box.camera
        intrinsics = torch.tensor([[camera.fx, camera.fy, camera.cx, camera.cy]], device=self._device)
        # Poses stay on the CPU in double precision, which not every device has.
        pose = torch.from_numpy(np.asarray(cam_from_world, np.float64))
        has_depth = bool((depth > 0).any())
        if self._reference is None or (has_depth and not self._reference_has_depth):
            # Coordinates change with the reference, so nothing observed before may be mixed with it.
            center, scale = reference_of(cells, intrinsics, size)
            self._reference, self._reference_has_depth = (pose, center, scale), has_depth
            self._ring.clear()
            for bound in self._bound:
                bound.belief = bound.last_seen = None
                bound.ground = Ground(self._config)
        ref_pose, center, scale = self._reference
        return FrameBatch(
            features=network.encode(image[None])[:, None].float(),
            rgb=image[None, None],
            depth_m=depth[None],
            cell_depth_m=cells[None],
            intrinsics=intrinsics,
            ref_from_cam=(ref_pose @ invert(pose)).float().to(self._device)[None, None],
            center=center,
            scale=scale,
        )

    def _bind(self, observed: Observation, frames: FrameBatch) -> None:
        if self._network.config.queries == "learned":
            self._bind_learned(frames)
            return
        if self._t == 0 and (self._discover_all or any(q.kind != "point" for _, q in self._waiting)):
            self._bind_slots(observed, frames)
        due = self._due()
        if due:
            size = self._network.config.encoder.image_size
            uv_px = np.array([q.uv_px for _, q in due], np.float32)
            uv = torch.from_numpy(self._letterbox.to_canvas(uv_px) / size)
            label = torch.tensor([LABELS.index(q.label) if q.label else UNKNOWN_LABEL for _, q in due])
            self._join(observed, frames, uv, label)
            for i, query in due:
                self._bound.append(self._start(i, query.name or f"point {i}", query.label))
                self._waiting.remove((i, query))

    def _start(self, query: int, name: str, label: str | None, slot: int | None = None) -> _Bound:
        return _Bound(query, name, label, slot, Ground(self._config))

    def _due(self) -> list[tuple[int, Query]]:
        return [(i, q) for i, q in self._waiting if q.kind == "point" and q.frame == self._t]

    def _bind_slots(self, observed: Observation, frames: FrameBatch) -> None:
        config = self._config
        slots = find_peaks(self._network, observed, radius_cells=config.slot_radius_cells)
        existence = (config.slot_gain * (slots.logit + config.slot_bias)).sigmoid().tolist()
        found = [LABELS[int(n)] for n in slots.label]
        bound: list[_Bound] = []
        if self._discover_all:
            good = [i for i, e in enumerate(existence) if e > config.slot_threshold]
            bound = [self._start(n, f"{found[i]} {n}", found[i], i) for n, i in enumerate(good)]
        for n, query in [(n, q) for n, q in self._waiting if q.kind != "point"]:
            used = {b.slot for b in bound}
            fits = [i for i, label in enumerate(found) if i not in used and query.label in (None, label)]
            if fits and existence[fits[0]] > config.prompt_threshold:
                slot = fits[0]
                bound.append(self._start(n, query.name or f"{found[slot]} {n}", found[slot], slot))
                self._waiting.remove((n, query))
        if bound:
            index = torch.tensor([b.slot for b in bound])
            self._join(observed, frames, slots.uv[index], slots.label[index])
            self._bound += bound

    def _join(self, observed: Observation, frames: FrameBatch, uv: Tensor, label: Tensor) -> None:
        """Bind more queries; the anchors of the others stay as they are."""
        uv, label = uv[None].to(self._device), label[None].to(self._device)
        uv_px = uv[:, None] * self._network.config.encoder.image_size
        point = frames.to_reference(uv_px, frames.near_depth_at(uv_px)).squeeze(1)
        valid = torch.ones(label.shape, dtype=torch.bool, device=self._device)
        anchor = self._network.bind(observed, uv, point, label, valid)
        self._anchor = anchor if self._anchor is None else self._anchor.join(anchor)

    def _bind_learned(self, frames: FrameBatch) -> None:
        """Learned queries are there from the start; a point is answered by the slot nearest to it when it is asked."""
        if self._anchor is None:
            self._anchor = self._network.slots(1)
        if self._t == 0:
            label = self._network.learned_label(self._anchor.content)[0].argmax(dim=-1)
            if self._discover_all:
                self._bound = [self._start(i, f"slot {i}", LABELS[int(n)], i) for i, n in enumerate(label)]
            for n, query in [(n, q) for n, q in self._waiting if q.kind != "point"]:
                used = {b.slot for b in self._bound}
                fits = [i for i, k in enumerate(label) if i not in used and query.label in (None, LABELS[int(k)])]
                if fits:
                    slot = fits[0]
                    self._bound.append(self._start(n, query.name or f"slot {slot}", LABELS[int(label[slot])], slot))
                    self._waiting.remove((n, query))
        due = self._due()
        if due:
            prediction = self._network.decode(self._anchor, self._ring[-1], frames)
            size = self._network.config.encoder.image_size
            for i, query in due:
                uv = torch.from_numpy(self._letterbox.to_canvas(np.array(query.uv_px, np.float64)) / size).to(
                    prediction.uv
                )
                slot = int((prediction.uv[0, -1] - uv).norm(dim=-1).argmin())
                self._bound.append(self._start(i, query.name or f"point {i}", query.label, slot))
                self._waiting.remove((i, query))

    def _answer(self, frames: FrameBatch, stamp_s: float, has_depth: bool) -> StreamState:
        if not self._bound or self._anchor is None:
            empty = np.zeros((0, 3), np.float32)
            return StreamState((), (), empty[:, :2], empty, empty[:, 0], empty[:, 0] > 0, (), stamp_s, has_depth, ())
        window = Observation.stack(list(self._ring))
        head = self._network.head
        if isinstance(head, HeatmapHead):
            x = self._network.embed(self._anchor, window)[:, -1:]
            newest = window.during(slice(-1, None))
            prediction = self._track_cells(head, x, newest)
            place = self._ground if self._config.ground else self._hold
            prediction, uv, point = place(
                prediction, lift_near(prediction, frames, self._config.lift_tolerance), frames
            )
        else:
            prediction = self._network.decode(self._anchor, window.during(slice(-1, None)), frames)
            index = torch.tensor([b.slot for b in self._bound])
            uv, point = prediction.uv[0, 0, index], prediction.point[0, 0, index]
            prediction = Prediction(*(getattr(prediction, n)[:, :, index] for n in Prediction.__dataclass_fields__))
        world = self._to_world(point, has_depth)
        visible_p = prediction.visible_logit[0, 0].sigmoid().cpu().numpy()
        confidence = prediction.right_logit[0, 0].sigmoid().cpu().numpy()
        visible = (visible_p > 0.5) & ((uv >= 0) & (uv <= 1)).all(-1).cpu().numpy()
        size = self._network.config.encoder.image_size
        return StreamState(
            names=tuple(b.name for b in self._bound),
            labels=tuple(b.label for b in self._bound),
            uv_px=self._letterbox.to_source(uv.cpu().numpy() * size).astype(np.float32),
            point_world=world,
            confidence=confidence.astype(np.float32),
            visible=visible,
            state=tuple(
                State.LOST if c < _LOST_BELOW else State.TRACKING if v else State.HELD
                for c, v in zip(confidence, visible, strict=True)
            ),
            stamp_s=stamp_s,
            has_depth=has_depth,
            query=tuple(b.query for b in self._bound),
        )

    def _track_cells(self, head: HeatmapHead, x: Tensor, newest: Observation) -> Prediction:
        """Fuse the newest heatmap with the belief and answer at the best cell."""
        assert self._anchor is not None
        logits = head.logits(x, newest)
        seen = head.confidences(x, logits, newest, logits.argmax(dim=-1))[0, 0, :, 0].sigmoid()
        cell_point = newest.cell_point[0, 0].float()
        size = self._network.config.encoder.image_size
        cell_uv = 2 * cell_centres(self._network.config, device=logits.device) / size - 1
        posterior, favour = torch.empty_like(logits[0, 0]), torch.zeros_like(logits[0, 0])
        if self._config.ground:
            place = cell_point.cpu().numpy()
            favour = torch.from_numpy(np.stack([b.ground.favour(place) for b in self._bound])).to(logits)
        # Queries that have just bound have no belief yet; those of all others live on the previous frame's cells.
        fresh_rows = [i for i, b in enumerate(self._bound) if b.belief is None]
        known_rows = [i for i, b in enumerate(self._bound) if b.belief is not None]
        for rows, fresh in ((fresh_rows, True), (known_rows, False)):
            if not rows:
                continue
            before = None if fresh else self._joint_belief(rows)
            after = update(before, logits[0, 0, rows], seen[rows], cell_point, cell_uv, favour[rows], self._config)
            posterior[rows] = after.probability
            for row, probability in zip(rows, after.probability, strict=True):
                self._bound[row].belief = Belief(probability[None], cell_point)
        fused = posterior.clamp(min=1e-12).log()[None, None]
        return head(x, self._anchor, newest, fused)

    def _joint_belief(self, rows: list[int]) -> Belief:
        beliefs = [b for b in (self._bound[i].belief for i in rows) if b is not None]
        return Belief(torch.cat([b.probability for b in beliefs]), beliefs[0].cell_point)

    def _hold(self, prediction: Prediction, point: Tensor, frames: FrameBatch) -> tuple[Prediction, Tensor, Tensor]:
        """Pixels and points, those of hidden entities where they were last seen."""
        seen = prediction.visible_logit[0, 0].sigmoid() >= self._config.hold_below
        for k, bound in enumerate(self._bound):
            if bool(seen[k]) or bound.last_seen is None:
                bound.last_seen = point[k]
        held = torch.stack([b.last_seen for b in self._bound if b.last_seen is not None])
        uv = frames.from_reference(held[None, None])[0, 0] / self._network.config.encoder.image_size
        keep = seen | ~torch.isfinite(uv).all(dim=-1)
        uv = torch.where(keep.unsqueeze(-1), prediction.uv[0, 0], uv)
        return prediction, uv, torch.where(keep.unsqueeze(-1), point, held)

    def _ground(self, prediction: Prediction, point: Tensor, frames: FrameBatch) -> tuple[Prediction, Tensor, Tensor]:
        """Pixels and points, drawn towards their joints; those of hidden entities by their joints alone.

        Where something came before the place of an entity that stood still and the answer leapt, it leapt onto what
        came: the entity is behind it, and the prediction's visibility is taken back.
        """
        joints = joint_rows(self._network.joint(prediction.embedding))
        seen, right = prediction.visible_logit[0, 0].sigmoid(), prediction.right_logit[0, 0].sigmoid()
        log_p = prediction.logits[0, 0].log_softmax(dim=-1)
        placed = point.clone()
        for k, bound in enumerate(self._bound):
            own = point[k].cpu().double().numpy()
            evidence = Evidence(frames, log_p[k], self._network.config)
            before = None if bound.last_seen is None else bound.last_seen.cpu().double().numpy()
            if before is not None and bound.ground.still and evidence.covers(before):
                leapt = not np.linalg.norm(own - before) < _LEAP
                seen[k] = seen[k].clamp(max=_AFTER_ALL) if leapt else seen[k]
            if before is None or seen[k] >= self._config.hold_below:
                if not np.isfinite(own).all():
                    continue
                if right[k] >= _LOST_BELOW:
                    bound.ground.see(own, joints[k])
                own = bound.ground.settle(own)
            else:
                own = bound.ground.hide(before, own, float(seen[k]), evidence.score, evidence.free)
            placed[k] = torch.from_numpy(own).to(placed)
            bound.last_seen = placed[k]
        uv = frames.from_reference(placed[None, None])[0, 0] / self._network.config.encoder.image_size
        uv = torch.where(torch.isfinite(uv).all(dim=-1, keepdim=True), uv, prediction.uv[0, 0])
        return replace(prediction, visible_logit=seen.logit()[None, None]), uv, placed

    def _to_world(self, point: Tensor, has_depth: bool) -> Float32[np.ndarray, "K 3"]:
        assert self._reference is not None
        pose, center, scale = self._reference
        metric = point.cpu().double() * scale.cpu().double() + center.cpu().double()
        if not has_depth:
            metric = torch.full_like(metric, torch.nan)
        return transform(invert(pose)[None], metric).numpy().astype(np.float32)


def _check_pixel(query: Query, camera: Camera) -> None:
    if query.uv_px is None:
        return
    x, y = query.uv_px
    if not (0 <= x <= camera.width and 0 <= y <= camera.height):
        raise InputError(
            f"query {query.name!r}: expected a pixel within {camera.width} x {camera.height}, got ({x:.1f}, {y:.1f})"
        )
