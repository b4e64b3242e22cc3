"""Queries on one link share one joint: where some are seen, the others are known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quest.grounding import LinkGroups
from quest.track.following import Following
from quest.track.placing import Placed

SIGMA = 0.02
"""Standard deviation of a well-seen point per coordinate, reference units; only motions far above it join queries."""


def share(links: LinkGroups, frame: int, following: Sequence[Following], placed: Placed) -> None:
    """Learn which queries move together, and place the hidden ones by those of their link that are seen.

    Args:
        links: what is known of the links; it learns.
        frame: index of the frame.
        following: the queries.
        placed: where they are in the frame; points of hidden ones are changed.
    """
    seen = {
        query.query: placed.point[k]
        for k, query in enumerate(following)
        if placed.trusted[k] and np.isfinite(placed.point[k]).all()
    }
    links.see(frame, seen, {query.query: query.ground.joint for query in following})
    for k, query in enumerate(following):
        if placed.held[k] or query.doubted:
            point = links.predict(query.query, seen)
            if point is not None:
                placed.point[k] = point
                if not query.doubted:
                    placed.judged[k] = point
