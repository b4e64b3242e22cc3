"""Why a query is probably lost, in words that someone who holds the camera understands."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from quest.filter.queries import Queries


def reason(queries: Queries, row: int, uv_px: Float[np.ndarray, "2"]) -> str:
    """What speaks for a loss: "not seen for 1.2 s where it should be; looks more like what is 140 px away".

    Args:
        queries: after a frame.
        row: which of them.
        uv_px: the answer, pixels of the source.
    """
    seen, unseen_s = queries.seen_log_odds[row], queries.unseen_s[row]
    if seen > 0:
        why = "looks little like its anchor"
    elif unseen_s > 0:
        why = f"not seen for {unseen_s:.1f} s where it should be"
    else:
        why = "behind something or out of view"
    if queries.rival_log_odds[row] < seen:
        return why
    return f"{why}; looks more like what is {np.linalg.norm(queries.rival_px[row] - uv_px):.0f} px away"
