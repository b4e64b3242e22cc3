"""Make the sample clip that ships with the package: one view of a procedural cabinet that no figure rests on.

    python benchmarks/make_sample.py

The object, seed and view are fixed, so the clip can be made again.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import tyro

from quest.cli.main import main
from quest.data.recording import write_recording
from quest.data.store import TakeStore

ASSETS = Path(__file__).parents[1] / "src" / "quest" / "assets"


@dataclass(frozen=True)
class MakeSample:
    """Render the sample clip."""

    object_id: str = "cabinet-104003"
    """Procedural object, of the validation part of the split; nothing was chosen on it."""
    level: int = 2
    """Joints that move one after the other, 60 frames each."""
    seed: int = 0
    """Seed of the take."""
    view: int = 0
    """Which camera."""
    out: Path = ASSETS / "sample"
    """Recording folder to write; it must not exist."""

    def run(self) -> int:
        """Render one take and write one of its views as a recording."""
        with tempfile.TemporaryDirectory() as folder:
            arguments = ("--objects", f"procedural:{self.object_id}", "--level", self.level, "--seed", self.seed)
            code = main(["generate", *map(str, arguments), "--out", folder])
            if code:
                return code
            store = TakeStore(folder)
            # Millimetres, as real sensors give, and half the size.
            write_recording(store.read_clip(store.names()[0], self.view), self.out, depth_scale_m=1e-3)
        return 0


if __name__ == "__main__":
    sys.exit(tyro.cli(MakeSample).run())
