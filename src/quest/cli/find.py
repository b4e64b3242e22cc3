"""``quest find``: what in pictures can be taken hold of."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tyro

from quest.cli.console import Console
from quest.errors import ConfigError, InputError
from quest.types import Clip
from quest.whole_file import whole_file

if TYPE_CHECKING:
    from quest.model.found import Found


@dataclass(frozen=True)
class Find:
    """Find what can be taken hold of in a picture, or in a frame of a recording: handles, knobs, rims, fronts, hinges.

    Prints a line for each with its probability of being right, and the door or drawer that it is on with how that
    opens. With --out a picture shows them, and a COCO file lists them.
    """

    source: tyro.conf.Positional[str]
    """A picture, or anything that quest track reads."""
    weights: str = "quest-s16"
    """Name, file, or owner/name on the Hugging Face hub."""
    frame: int = 0
    """Which frame of a recording."""
    text: str | None = None
    """Only what a text means, such as "the lever of the left door"; how it is understood is printed."""
    threshold: float | None = None
    """Least probability; default: that of the weights."""
    json: bool = False
    """Print JSON instead: a list of what was found."""
    out: Path | None = None
    """Folder for found.png and found.json, which is a COCO file."""

    def run(self) -> int:
        """Find, print, write."""
        import quest
        from quest.data.pictures import PICTURES, read_picture
        from quest.data.recording import read_recording
        from quest.text import choose, understand
        from quest.track import Tracker

        if self.threshold is not None and not 0 <= self.threshold <= 1:
            raise ConfigError(f"find: expected a threshold from 0 to 1, got {self.threshold}")
        meaning = None if self.text is None else understand(self.text)
        tracker = quest.load(self.weights, monitor=False)
        if not isinstance(tracker, Tracker):
            raise ConfigError(f"find: {self.weights} is the published network, which finds nothing in single pictures")
        path = Path(self.source)
        if path.suffix.lower() in PICTURES and path.is_file():
            clip = Clip.from_arrays(read_picture(path)[None], name=path.name)
        else:
            clip = read_recording(self.source)
        if not 0 <= self.frame < len(clip):
            raise InputError(f"{self.source}: expected a frame from 0 to {len(clip) - 1}, got {self.frame}")
        found = tracker.find(clip.rgb[self.frame])
        config, missing = tracker.config, ""
        least = config.threshold if self.threshold is None else self.threshold
        console = Console()
        if meaning is not None:
            of_any = config.prompt_threshold if self.threshold is None else least
            chosen = choose(found, meaning, least=least, least_of_any=of_any)
            found, least, missing = found.select(chosen.rows), 0.0, chosen.missing
            Console(stderr=self.json).print(f"understood: {meaning}")
        things = listed(found, least=least)
        if not things and not missing:
            missing = "nothing found; a lower --threshold shows what is less sure"
        if self.json:
            print(json.dumps(things, indent=1))
        else:
            for thing in things:
                console.print(_line(thing))
            console.print("; ".join(filter(None, (f"{len(things)} found" * bool(things), missing))))
        if self.out is not None:
            self._write(clip.rgb[self.frame], found, things, least)
            console.print(f"wrote {self.out / 'found.png'} and found.json")
        return 0

    def _write(self, rgb: np.ndarray, found: Found, things: list[dict[str, Any]], least: float) -> None:
        from PIL import Image

        from quest.viz.found import draw_found

        assert self.out is not None
        self.out.mkdir(parents=True, exist_ok=True)
        with whole_file(self.out / "found.png") as unfinished:
            drawn = draw_found(rgb, found, least=least, all_panels=self.text is None)
            Image.fromarray(drawn).save(unfinished, format="PNG")
        with whole_file(self.out / "found.json") as unfinished:
            unfinished.write_text(json.dumps(coco(things, Path(self.source).name, rgb.shape), indent=1) + "\n")


def listed(found: Found, *, least: float) -> list[dict[str, Any]]:
    """What was found with at least some probability, best first, as plain values."""
    from quest.model.finder import OPENINGS, PANELS

    things = []
    for i, label in enumerate(found.labels):
        p = found.p[i]
        if p < least:
            continue
        thing: dict[str, Any] = {"label": label, "p": round(float(p), 3), "uv_px": found.uv_px[i].round(1).tolist()}
        if not np.isnan(found.box_px[i, 0]):
            thing["box_px"] = found.box_px[i].round(1).tolist()
        thing["intent"] = "lift" if found.lift_p[i] > 0.5 else "open"
        panel = int(found.panel[i])
        if panel >= 0:
            panels = found.panels
            opening = panels.opening_p[panel]
            thing["on"] = {
                "kind": PANELS[int(panels.kind[panel])],
                "box_px": panels.box_px[panel].round(1).tolist(),
                "opening": {name: round(float(value), 3) for name, value in zip(OPENINGS, opening, strict=True)},
            }
        things.append(thing)
    return things


def coco(things: list[dict[str, Any]], file: str, shape: tuple[int, ...]) -> dict[str, Any]:
    """What was found as a COCO file; rims, fronts and hinges are boxes without extent, and key points too."""
    from quest.model.found import LABELS_FOUND

    marks = []
    for i, thing in enumerate(things):
        x, y = thing["uv_px"]
        left, top, right, bottom = thing.get("box_px", (x, y, x, y))
        box = [left, top, round(right - left, 1), round(bottom - top, 1)]
        extra = {key: thing[key] for key in ("intent", "on") if key in thing}
        marks.append(
            {"id": i + 1, "image_id": 1, "category_id": 1 + LABELS_FOUND.index(thing["label"]), "bbox": box,
             "area": round(box[2] * box[3], 1), "iscrowd": 0, "score": thing["p"], "keypoints": [x, y, 2],
             "num_keypoints": 1, **extra}
        )  # fmt: skip
    return {
        "images": [{"id": 1, "file_name": file, "width": shape[1], "height": shape[0]}],
        "annotations": marks,
        "categories": [
            {"id": 1 + i, "name": name, "keypoints": ["hold"], "skeleton": []} for i, name in enumerate(LABELS_FOUND)
        ],
    }


def _line(thing: dict[str, Any]) -> str:
    x, y = thing["uv_px"]
    line = f"{thing['label']:7s} {thing['p']:.2f}  ({x:.0f}, {y:.0f})"
    if thing["intent"] == "lift":
        line += "  to lift"
    if "on" in thing:
        opening = max(thing["on"]["opening"], key=thing["on"]["opening"].get)
        way = "slides out" if opening == "slides" else f"turns about its {opening} edge"
        what = {"cabinet": "drawer" if opening == "slides" else "cabinet door", "door": "door"}
        line += f"  on a {what.get(thing['on']['kind'], 'refrigerator door')} that {way}"
        line += f" ({thing['on']['opening'][opening]:.0%})"
    return line
