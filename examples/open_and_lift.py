"""Ask for two places of one kind on one thing: the rim that opens a laptop and the rim that it is lifted by.

    python examples/open_and_lift.py
    python examples/open_and_lift.py --recording path/to/mine

Without a recording, a procedural laptop is rendered once. Its lid is closed at first, and both rims are then a few
pixels apart. Weights find both by what they are for; one goes with the lid, the other one should stay.
"""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

import quest
from quest.data.recording import read_recording
from quest.data.store import TakeStore
from quest.types import Clip, Tracks


@dataclass(frozen=True)
class OpenAndLift:
    """Follow both rims of a laptop and say which of them moved."""

    recording: Path | None = None
    """A recording of your own (docs/recordings.md)."""
    out: Path = Path("runs/laptop")
    """Folder for the rendered take."""
    laptop: str = "laptop-7"
    """The laptop that is rendered, and its number."""
    weights: str = "quest-s16"
    """Weights that know intents."""

    def run(self) -> None:
        """Print where both rims are, four times in all, and how far each went."""
        tracks = follow(quest.load(self.weights), read_recording(self.recording) if self.recording else self.render())
        for t in np.linspace(0, len(tracks) - 1, 4).astype(int):
            for name, (x, y, z) in zip(tracks.names, tracks.point_world[t], strict=True):
                print(f"{tracks.stamp_s[t]:5.2f} s  {name:<18} {x:6.3f} {y:6.3f} {z:6.3f} m")
        for name, metres in zip(tracks.names, travelled_m(tracks), strict=True):
            print(f"{name}: went {100 * metres:.0f} cm" if np.isfinite(metres) else f"{name}: not found")

    def render(self) -> Clip:
        """A lid that is opened, seen by one camera."""
        command = ["generate", "--objects", f"procedural:{self.laptop}", "--views", "1", "--out", str(self.out)]
        subprocess.run([sys.executable, "-m", "quest.cli.main", *command], check=True)
        return TakeStore(str(self.out)).read_clip(f"{self.laptop}-L1-s000000")


def follow(tracker: quest.Tracker, clip: Clip) -> Tracks:
    """Both rims, each asked for by what one takes hold of it for."""
    queries = [
        quest.Query.semantic("rim", intent="open", name="opens"),
        quest.Query.semantic("rim", intent="lift", name="lifts"),
    ]
    return tracker.track(clip, queries)


def travelled_m(tracks: Tracks) -> list[float]:
    """How far each entity is at last from where it was first known, metres."""
    known = [p[np.isfinite(p).all(-1)] for p in tracks.point_world.transpose(1, 0, 2)]
    return [float(np.linalg.norm(p[-1] - p[0])) if len(p) else float("nan") for p in known]


if __name__ == "__main__":
    tyro.cli(OpenAndLift).run()
