"""Frozen encoder features of every frame of a store, computed once and read by memory map.

One folder per encoder, in it one per view of a take, written beside its place and renamed, so that a killed run leaves
whole entries or nothing. An entry is stale when the take changed, and is then made again. Runs with different encoders
can share a cache.
"""

from __future__ import annotations

import contextlib
import glob
import json
import os
import shutil
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float16, Float32, Int8, UInt8, UInt16

from quest.data.store import TakeStore
from quest.errors import ConfigError
from quest.geometry.letterbox import Letterbox
from quest.model.encoder import Encoder
from quest.model.precision import fast_bfloat16
from quest.model.weights import weights_digest
from quest.types import LABELS, Camera, Take

_VERSION = 2
DEPTH_UNIT_M = 1e-4
"""What depth is stored in, metres."""
_LEFT_AFTER_S = 3600.0
"""Age at which what is half made or half removed belongs to no process any more."""


@dataclass(frozen=True)
class CachedView:
    """One view of a take as the network takes it.

    What is large is opened as a memory map at every access, so that a view costs no open file: a day's rendering has
    more views than a process may have files.

    Raises:
        ConfigError: another run has put another number of frames in its place.
    """

    folder: Path
    """Where its arrays are."""
    object_id: str
    """The object in it."""
    camera: Camera
    """Intrinsics of the letterboxed input."""
    half_diagonal_m: float
    """Metres per normalised unit."""
    cam_from_world: Float32[np.ndarray, "T 4 4"]
    """Pose of each frame."""
    uv_px: Float32[np.ndarray, "T K 2"]
    """True pixel of the letterboxed input, per tracked entity."""
    visible: Bool[np.ndarray, "T K"]
    """Whether the entity is seen."""
    point_world: Float32[np.ndarray, "T K 3"]
    """True world point, metres."""
    label: Int8[np.ndarray, " K"]
    """Index into LABELS."""
    revolute: Bool[np.ndarray, " K"]
    """Whether the entity's joint turns."""
    axis_world: Float32[np.ndarray, "K 6"]
    """Origin and direction of the joint's axis at rest; zero for what is fixed in the base."""

    def __len__(self) -> int:
        return len(self.visible)

    @property
    def name(self) -> str:
        """Take and view."""
        return self.folder.name

    @property
    def features(self) -> Float16[np.ndarray, "T N E"]:
        """Tokens of the encoder."""
        return self._map("features")

    @property
    def depth(self) -> UInt16[np.ndarray, "T S S"]:
        """Letterboxed depth in units of 0.1 mm, 0 where missing."""
        return self._map("depth")

    def _map(self, name: str) -> np.ndarray:
        array = np.load(self.folder / f"{name}.npy", mmap_mode="r", allow_pickle=False)
        if len(array) != len(self):
            raise ConfigError(
                f"{self.folder}: expected {len(self)} frames, got {len(array)}; another run has prepared another take "
                "of this name here meanwhile, give each its own --cache"
            )
        return array


_READ = ("cam_from_world", "uv_px", "visible", "point_world", "label", "revolute", "axis_world")


class FeatureCache:
    """Views of takes with features of an encoder with its initial weights, in a folder of its own below ``root``."""

    def __init__(self, root: Path, encoder: Encoder) -> None:
        self.encoder = encoder.eval()
        layout = json.dumps([_VERSION, asdict(encoder.config)])
        self.encoder_hash = weights_digest(encoder, beside=layout)
        self.root = root / self.encoder_hash[:12]

    def build(self, store: TakeStore, names: list[str], *, device: torch.device) -> Iterator[int]:
        """Make what is missing or stale of some takes; yields the number of frames of every view that is ready."""
        self.root.mkdir(parents=True, exist_ok=True)
        self.encoder.to(device)
        for name in names:
            stamp = {"encoder": self.encoder_hash, "take": store.data_hash(name)}
            entries = self._entries(name)
            if not self._complete(entries, stamp):
                for entry in entries:  # also of views that the take no longer has
                    _remove(entry)
                take = store.read(name)
                entries = [self._write(take, view, stamp, device) for view in range(len(take.views))]
            for entry in entries:
                yield len(np.load(entry / "visible.npy", mmap_mode="r"))

    def views(self, names: list[str]) -> list[CachedView]:
        """Open the prepared views of these takes.

        Raises:
            ConfigError: there is none.
        """
        views = [self._open(entry) for name in names for entry in self._entries(name)]
        views = [v for v in views if v.visible.shape[1] > 0]
        if not views:
            raise ConfigError(f"{self.root}: no prepared views with entities; generate takes first")
        return views

    def _entries(self, name: str) -> list[Path]:
        found = self.root.glob(f"{glob.escape(name)}-v*")
        return sorted(path for path in found if path.name.removeprefix(f"{name}-v").isdigit())

    def _complete(self, entries: list[Path], stamp: dict[str, str]) -> bool:
        """Whether every view of a take is there and of this take and encoder."""
        try:
            metas = [json.loads((entry / "meta.json").read_text()) for entry in entries]
        except (OSError, ValueError):  # what a killed removal left
            return False
        return bool(metas) and all(m["stamp"] == stamp and m["views"] == len(metas) for m in metas)

    def _write(self, take: Take, view: int, stamp: dict[str, str], device: torch.device) -> Path:
        clip, truth, tracked = take.views[view].clip, take.views[view], take.tracked
        box = Letterbox(clip.camera, self.encoder.config.image_size)
        rgb = np.stack([box.rgb(image) for image in clip.rgb])
        depth_m = np.zeros(rgb.shape[:3], np.float32)
        if clip.depth_m is not None:
            depth_m = np.stack([box.depth(image) for image in clip.depth_m])
        joints = [take.info.entities[e].joint for e in tracked]
        moving = [j >= 0 for j in joints]
        axis = np.zeros((len(tracked), 6), np.float32)
        axis[moving] = take.joint_axis[0, [j for j in joints if j >= 0]].reshape(-1, 6)
        arrays = {
            "features": encode_images(self.encoder, rgb, device=device),
            "depth": np.clip(np.rint(depth_m / DEPTH_UNIT_M), 0, 65535).astype(np.uint16),
            "cam_from_world": clip.cam_from_world.astype(np.float32),
            "uv_px": box.to_canvas(truth.uv_px[:, tracked]).astype(np.float32),
            "visible": truth.visible[:, tracked],
            "point_world": take.point_world[:, tracked],
            "label": np.array([LABELS.index(take.info.entities[e].label) for e in tracked], np.int8),
            "revolute": np.array([j >= 0 and take.info.joints[j].kind == "revolute" for j in joints], bool),
            "axis_world": axis,
        }
        meta = {
            "stamp": stamp,
            "views": len(take.views),
            "object_id": take.info.object_id,
            "camera": asdict(box.camera),
            "half_diagonal_m": take.info.half_diagonal_m,
        }
        entry = self.root / f"{take.info.name}-v{view}"
        for left in self.root.glob(f".*-{glob.escape(entry.name)}.*"):
            with contextlib.suppress(FileNotFoundError):  # another process has just finished it
                if time.time() - left.stat().st_mtime > _LEFT_AFTER_S:
                    shutil.rmtree(left, ignore_errors=True)
        partial = self.root / f".partial-{entry.name}.{os.getpid()}"
        partial.mkdir()
        for name, array in arrays.items():
            np.save(partial / f"{name}.npy", array, allow_pickle=False)
        (partial / "meta.json").write_text(json.dumps(meta))
        _remove(entry)  # another process may have made it meanwhile
        partial.rename(entry)
        return entry

    def _open(self, entry: Path) -> CachedView:
        meta = json.loads((entry / "meta.json").read_text())
        arrays = {name: np.load(entry / f"{name}.npy", allow_pickle=False) for name in _READ}
        return CachedView(
            folder=entry,
            object_id=meta["object_id"],
            camera=Camera(**meta["camera"]),
            half_diagonal_m=meta["half_diagonal_m"],
            **arrays,
        )


def _remove(entry: Path) -> None:
    """Remove an entry whole or not at all, as far as others can see."""
    gone = entry.with_name(f".gone-{entry.name}.{os.getpid()}")
    with contextlib.suppress(FileNotFoundError):
        entry.rename(gone)
    shutil.rmtree(gone, ignore_errors=True)


def encode_images(
    encoder: Encoder, rgb: UInt8[np.ndarray, "T S S 3"], *, device: torch.device, batch: int = 16
) -> Float16[np.ndarray, "T N E"]:
    """Features of many images, in bfloat16 arithmetic where that is fast."""
    out = []
    with torch.inference_mode(), torch.autocast(device.type, torch.bfloat16, enabled=fast_bfloat16(device)):
        for start in range(0, len(rgb), batch):
            images = torch.from_numpy(rgb[start : start + batch]).to(device)
            out.append(encoder(images).to(torch.float16).cpu().numpy())
    return np.concatenate(out)
