"""The points that users ask for, carried along with what the network follows.

A network has its own idea of where on a handle the point of a handle is: a few pixels from where the user put it, and
on a front that is seen at a slant those pixels are a long way in depth. What lies between both is known in the first
frame. From then on it turns with the link.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from quest.geometry.vectors import rotated
from quest.grounding import JointKind
from quest.model.decoder import Prediction
from quest.model.observation import FrameBatch
from quest.track.following import Following

_SAME_THING_PX = 8.0
"""Where the network sees a query farther from its pixel than that, it does not see what was asked for."""


def marked(
    following: Sequence[Following], point: Float[np.ndarray, "K 3"], prediction: Prediction, frames: FrameBatch
) -> Float[np.ndarray, "K 3"]:
    """Where the points that were asked for are, by where the network's own points of the same entities are.

    Args:
        following: the queries; those asked for as a pixel of this frame get their mark.
        point: the network's own points, drawn to their joints or held on them, reference frame.
        prediction: the network's answers for the frame (B = T = 1).
        frames: the frame.
    """
    shown = point.copy()
    for k, query in enumerate(following):
        if query.asked_px is not None:
            uv_px = prediction.uv[0, 0, k].float() * frames.depth_m.shape[-1]
            query.mark, query.mark_px = _marks(query.asked_px, uv_px, point[k], frames)
            query.asked_px = None
        if query.mark is not None:
            shown[k] = point[k] + _turned(query, point[k])
    return shown


def beside(
    following: Sequence[Following], uv: Float[Tensor, "K 2"], point: Float[np.ndarray, "K 3"], *, size: int
) -> Float[Tensor, "K 2"]:
    """Pixels of the points that were asked for, where places do not tell: as far from the network's as at first.

    Args:
        following: the queries.
        uv: where they are, in [0, 1]^2 of the input.
        point: their places as :func:`marked` gives them; NaN where there is no depth.
        size: of the input, pixels.
    """
    shift = np.zeros((len(following), 2))
    for k, query in enumerate(following):
        if query.mark_px is not None and (query.mark is None or not np.isfinite(point[k]).all()):
            shift[k] = query.mark_px / size
    return uv + torch.from_numpy(shift).to(uv)


def _marks(
    asked_px: Float[Tensor, "2"], uv_px: Float[Tensor, "2"], own: Float[np.ndarray, "3"], frames: FrameBatch
) -> tuple[Float[np.ndarray, "3"] | None, Float[np.ndarray, "2"] | None]:
    """From the network's own point to the one under the user's pixel, and from its pixel; None where not known."""
    asked_px = asked_px.to(uv_px)
    if float((uv_px - asked_px).norm()) > _SAME_THING_PX:
        return None, None
    at = asked_px[None, None, None]
    mark = frames.to_reference(at, frames.edge_depth_at(at))[0, 0, 0].cpu().double().numpy() - own
    return mark if np.isfinite(mark).all() else None, (asked_px - uv_px).cpu().double().numpy()


def _turned(query: Following, place: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """The mark of a query, turned as its link has turned by the time the query is at a place."""
    assert query.mark is not None
    joint = query.ground.joint
    if joint is None or joint.kind is not JointKind.REVOLUTE or query.home is None or not np.isfinite(place).all():
        return query.mark
    before, now = joint.locate(np.stack((query.home, place)))
    return rotated(query.mark, joint.axis, float(now - before))
