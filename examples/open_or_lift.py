"""One laptop, two intents: follow the rim to open it by and the rim to lift it by, in one stream.

    python examples/open_or_lift.py
    python examples/open_or_lift.py --object procedural:laptop-104012

Makes a take of a procedural laptop first, if it is not there yet.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

import quest
from quest.cli.main import main as run_quest
from quest.data.store import TakeStore
from quest.viz.overlay import write_overlay


@dataclass(frozen=True)
class OpenOrLift:
    """Ask for both rims of a laptop and say where they went."""

    object: str = "procedural:laptop-104011"
    """The laptop."""
    out: Path = Path("outputs/open_or_lift")
    """Folder for the take and the video."""
    weights: str = "quest-s16"
    """Name or file of the weights."""

    def run(self) -> int:
        """Make the take if it is not there, track, print, draw."""
        code = run_quest(["generate", "--objects", self.object, "--views", "1", "--out", str(self.out / "takes")])
        if code:
            return code
        store = TakeStore(self.out / "takes")
        name = next(name for name in store.names() if name.startswith(self.object.removeprefix("procedural:")))
        clip = store.read_clip(name, 0)
        queries = [quest.Query.semantic("rim", intent=intent, name=intent) for intent in ("open", "lift")]
        tracks = quest.load(self.weights).track(clip, queries)
        for k, intent in enumerate(tracks.names):
            point = tracks.point_world[:, k]
            known = point[np.isfinite(point).all(-1)]
            if not len(known):
                print(f"{intent}: not found")
                continue
            way = np.linalg.norm(known - known[0], axis=-1).max()
            print(f"{intent}: found in frame {int(np.isfinite(point).all(-1).argmax())}, moved by {100 * way:.1f} cm")
        write_overlay(clip, tracks, self.out / "overlay.mp4")
        print(f"watch {self.out / 'overlay.mp4'}")
        return 0


if __name__ == "__main__":
    raise SystemExit(tyro.cli(OpenOrLift).run())
