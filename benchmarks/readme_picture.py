"""Draw the animated picture of the README: both sample clips as the shipped weights follow them.

    python benchmarks/readme_picture.py

Nothing is drawn by hand: it is what ``quest track sample`` and ``quest track sample-alarm`` draw, smaller.
"""

from __future__ import annotations

import io
import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import tyro
from PIL import Image

import quest
from quest.data.recording import read_recording
from quest.data.sample import SAMPLES, sample_folder
from quest.viz.overlay import OverlayPainter


@dataclass(frozen=True)
class ReadmePicture:
    """Track the sample clips and write an animated WebP."""

    out: Path = Path(__file__).parents[1] / "docs" / "images" / "demo.webp"
    """File to write."""
    width: int = 640
    """Width, pixels."""
    frames_per_s: float = 7.5
    """Pictures per second of the clips; each clip's last one stays for a second."""
    most_bytes: int = 3_000_000
    """The quality is lowered until the file is not larger."""

    def run(self) -> int:
        """Track, draw, write."""
        tracker = quest.load("quest-s16")
        pictures: list[Image.Image] = []
        durations_ms: list[int] = []
        for name in SAMPLES:
            clip = read_recording(sample_folder(name))
            painter = OverlayPainter(clip, tracker.track(clip))
            ticks = np.arange(clip.stamp_s[0], clip.stamp_s[-1], 1 / self.frames_per_s)
            shown = np.unique([*np.searchsorted(clip.stamp_s, ticks - 1e-6), len(clip) - 1])
            pictures += [self._small(painter.frame(t)) for t in range(len(clip)) if t in shown]
            durations_ms += [round(1000 / self.frames_per_s)] * (len(shown) - 1) + [1000]
        for quality in range(80, 0, -10):
            data = io.BytesIO()
            pictures[0].save(
                data, "WEBP", save_all=True, append_images=pictures[1:], duration=durations_ms, loop=0,
                quality=quality, method=4,
            )  # fmt: skip
            if data.tell() <= self.most_bytes:
                break
        self.out.write_bytes(data.getvalue())
        print(f"{self.out}: {len(pictures)} pictures, {data.tell() / 1e6:.2f} MB at quality {quality}")
        return 0

    def _small(self, frame: np.ndarray) -> Image.Image:
        height = round(self.width * frame.shape[0] / frame.shape[1])
        return Image.fromarray(cv2.resize(frame, (self.width, height), interpolation=cv2.INTER_AREA))


if __name__ == "__main__":
    sys.exit(tyro.cli(ReadmePicture).run())
