"""Boxes of a detector, or masks of a segmenter, as queries: found once, then followed.

Put the detector of your choice into ``detect``. Its boxes are (left, top, right, bottom) in pixels of the picture, as
Grounding DINO and YOLO give them (those of Grounding DINO's own code are shares of the picture: multiply by its size).
A mask of SAM goes into ``quest.Query.mask`` as it is.
"""

from __future__ import annotations

import numpy as np

import quest

Box = tuple[float, float, float, float]


def detect(rgb: np.ndarray) -> list[tuple[str, Box]]:
    """Names and boxes of things in a picture; a stand-in, which knows where two handles of the packaged clip are."""
    del rgb
    return [("door", (440.0, 197.0, 456.0, 251.0)), ("neighbour", (372.0, 89.0, 425.0, 102.0))]


def main() -> None:
    """Detect in the first frame, follow through all."""
    clip = quest.read("sample")
    queries = [quest.Query.box(0, *box, name=name) for name, box in detect(clip.rgb[0])]
    tracks = quest.load("quest-s16").track(clip, queries)
    for k, query in enumerate(queries):
        print(query, "->", tracks.describe(k))


if __name__ == "__main__":
    main()
