"""Mirror images of takes agree with themselves, and twice mirrored is as before."""

from __future__ import annotations

import numpy as np
import pytest

from quest.data.mirror import mirror_take, mirrored_name
from quest.data.verify import Check, check_truth, check_view
from quest.types import Take
from tests.synthetic import make_take


def checks(take: Take) -> list[Check]:
    return [*check_truth(take), *(c for i, view in enumerate(take.views) for c in check_view(take, view, i))]


def test_a_mirrored_take_is_as_consistent_as_the_take():
    take = make_take(frames=16)
    mirrored = mirror_take(take)
    assert mirrored.info.name == mirrored_name(take.info.name) != take.info.name
    for before, after in zip(checks(take), checks(mirrored), strict=True):
        assert (after.name, after.passed) == (before.name, before.passed)
        assert after.worst == pytest.approx(before.worst, abs=1e-3)
    np.testing.assert_allclose(np.linalg.det(mirrored.views[0].clip.cam_from_world[:, :3, :3]), 1, atol=1e-6)
    assert (mirrored.views[0].clip.rgb == take.views[0].clip.rgb[:, :, ::-1]).all()


def test_twice_mirrored_is_as_before():
    take = make_take(frames=10, views=1)
    again = mirror_take(mirror_take(take))
    for name in ("point_world", "flow_world", "link_pose", "joint_position", "joint_axis"):
        np.testing.assert_allclose(getattr(again, name), getattr(take, name), atol=1e-6)
    before, after = take.views[0], again.views[0]
    np.testing.assert_allclose(after.uv_px, before.uv_px, atol=1e-4)
    np.testing.assert_allclose(after.clip.cam_from_world, before.clip.cam_from_world, atol=1e-6)
    assert after.clip.camera.cx == pytest.approx(before.clip.camera.cx)
    assert (after.link_id == before.link_id).all()
