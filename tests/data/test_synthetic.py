"""The fake take is true: what tests downstream rely on."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from quest.geometry import lift_depth, project, transform
from quest.types import Take
from tests.synthetic import make_take


@pytest.fixture(scope="module")
def take() -> Take:
    return make_take(frames=24, views=3, hinges=True)


def test_points_project_to_their_pixels(take: Take):
    for view in take.views:
        pose = torch.from_numpy(view.clip.cam_from_world)[:, None]
        uv = project(transform(pose, torch.from_numpy(take.point_world).double()), view.clip.camera)
        np.testing.assert_allclose(view.uv_px, uv.numpy(), atol=0.01)


def test_points_ride_on_their_links(take: Take):
    links = [entity.link for entity in take.info.entities]
    homogeneous = np.concatenate([take.point_world, np.ones_like(take.point_world[..., :1])], axis=-1)
    local = np.einsum("teij,tej->tei", np.linalg.inv(take.link_pose[:, links]), homogeneous)
    np.testing.assert_allclose(local, np.broadcast_to(local[:1], local.shape), atol=1e-5)


def test_depth_and_mask_of_a_visible_point_are_its_own(take: Take):
    seen = 0
    for view in take.views:
        assert view.clip.depth_m is not None
        lifted = lift_depth(torch.from_numpy(view.clip.depth_m).double(), view.clip.camera)
        world = transform(torch.linalg.inv(torch.from_numpy(view.clip.cam_from_world))[:, None, None], lifted).numpy()
        for t, e in zip(*np.nonzero(view.visible), strict=True):
            x, y = np.floor(view.uv_px[t, e]).astype(int)
            if e in take.tracked:
                assert np.linalg.norm(world[t, y, x] - take.point_world[t, e]) < 0.1
                assert (view.entity_id[t, y - 1 : y + 2, x - 1 : x + 2] == e + 1).any()
                seen += 1
    assert seen > 100


def test_motion(take: Take):
    np.testing.assert_array_equal(
        take.point_world[:8], np.broadcast_to(take.point_world[:1], take.point_world[:8].shape)
    )
    assert take.moved[take.tracked].all()
    assert not take.moved[-2], "the hinge of a door rests"
    np.testing.assert_allclose(take.point_world[:-1] + take.flow_world[:-1], take.point_world[1:], atol=1e-6)
    np.testing.assert_allclose(take.joint_position[0], 0, atol=1e-9)
    visible = np.concatenate([view.visible[:, take.tracked] for view in take.views])
    assert 0.5 < visible.mean() < 1


def test_same_seed_same_take():
    a, b, c = make_take(frames=2, seed=3), make_take(frames=2, seed=3), make_take(frames=2, seed=4)
    np.testing.assert_array_equal(a.views[0].clip.rgb, b.views[0].clip.rgb)
    assert (a.views[0].clip.rgb != c.views[0].clip.rgb).any()
