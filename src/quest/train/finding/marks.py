"""What is labelled in a picture, and where it is after the picture was scaled, mirrored or cut."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from quest.model.finder import OPENINGS, PANELS, PLACES

KINDS = (*PLACES, *PANELS)
"""What a mark can be."""
UNKNOWN = -1


@dataclass(frozen=True)
class Marks:
    """N labelled things of one picture."""

    kind: Int[np.ndarray, " N"]
    """Index into :data:`KINDS`."""
    box_px: Float[np.ndarray, "N 4"]
    """Left, top, right and bottom edges; those of rims, fronts and hinges are one point."""
    point_px: Float[np.ndarray, "N 2"]
    """Where to take hold of it: its middle, where nothing better is known."""
    knob: Int[np.ndarray, " N"]
    """1 for a knob, 0 for a handle, -1 where that is not known."""
    lift: Int[np.ndarray, " N"]
    """1 for what one lifts the whole thing by, 0 for what opens a part, -1 where that is not known."""
    opening: Int[np.ndarray, " N"]
    """Of panels, index into :data:`quest.model.finder.OPENINGS`, -1 where that is not known."""
    known: Bool[np.ndarray, " C"]
    """Of which of :data:`KINDS` all that is seen is labelled, so that what is unlabelled is none."""

    def __len__(self) -> int:
        return len(self.kind)

    def only(self, rows: Bool[np.ndarray, " N"]) -> Marks:
        """Some of them."""
        return Marks(**{f.name: getattr(self, f.name)[rows] for f in fields(self) if f.name != "known"},
                     known=self.known)  # fmt: skip

    def warped(
        self, scale: Float[np.ndarray, "2"], shift_px: Float[np.ndarray, "2"], size_px: tuple[int, int]
    ) -> Marks:
        """Where they are in a picture that was scaled, then shifted, then cut; mirrored where a scale is negative.

        Args:
            scale: along x and y.
            shift_px: along x and y.
            size_px: width and height of the cut.

        Returns:
            Those whose point is in the cut; their boxes may reach out of it.
        """
        corners = self.box_px.reshape(-1, 2, 2) * scale + shift_px
        box = np.concatenate((corners.min(axis=1), corners.max(axis=1)), axis=1)
        point = self.point_px * scale + shift_px
        opening = self.opening
        if scale[0] < 0:
            sides = [OPENINGS.index(side) for side in ("left", "right")]
            opening = np.select([opening == sides[0], opening == sides[1]], sides[::-1], opening)
        inside = np.asarray(((point > 0) & (point < np.array(size_px))).all(axis=1))
        return replace(self, box_px=box, point_px=point, opening=opening).only(inside)
