"""One query that is followed."""

from __future__ import annotations

import numpy as np
import pytest

from quest.track.following import Following
from quest.track.grounded import Ground
from quest.track.settings import TrackerConfig


@pytest.mark.parametrize("found", [False, True])
def test_what_goes_back_or_is_found_begins_in_plain_view(found: bool):
    """What hid it, and how often it was refused, was said of where it was before."""
    place = np.zeros(3)
    query = Following(0, "handle", None, Ground(TrackerConfig()), place=place, buried=True, refused=3)
    query.keep()
    if found:
        query.trust(np.ones(3))
    else:
        query.doubt()
    assert (query.buried, query.refused, query.doubted) == (False, 0, not found)
    assert query.place is not None
    np.testing.assert_array_equal(query.place, np.ones(3) if found else place)
