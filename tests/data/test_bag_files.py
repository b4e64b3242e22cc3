"""Bags as files and folders: damage, names, and arguments that are not for them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from quest.data.recording import open_recording, read_recording
from quest.errors import RecordingError
from tests.data.bag_drive import DEPTH_MM, FRAMES, colours, depths, info, recording
from tests.data.bags import write_bag, write_mcap, write_ros1


def test_arguments_are_checked(tmp_path: Path):
    path = write_mcap(tmp_path / "bag.mcap", [info(), colours(0), depths(0)])
    for scale in (0.0, -1.0, float("nan")):
        with pytest.raises(RecordingError, match=r"depth_scale_m is .*, expected a positive number"):
            open_recording(path, depth_scale_m=scale)
    with pytest.raises(RecordingError, match="is for a folder or video, and this is an MCAP file"):
        open_recording(path, depth=tmp_path)
    found = read_recording(path, depth_scale_m=2e-3)
    assert found.depth_m is not None
    np.testing.assert_allclose(found.depth_m[0], DEPTH_MM[0] / 500, atol=1e-5)


@pytest.mark.parametrize("compression", [None, "BZ2", "LZ4"])
def test_torn_bags_of_ros1(compression: str | None, tmp_path: Path):
    path = write_ros1(tmp_path / "bag.bag", recording(), compression=compression)
    whole, refused = path.read_bytes(), 0
    for number in range(10):
        torn = bytearray(whole)
        if number % 3 == 2:
            torn = torn[: len(whole) * number // 10]
        for at in np.random.default_rng(number).integers(0, len(torn), 6):
            torn[at] ^= 0xFF
        path.write_bytes(torn)
        try:
            read_recording(path)
        except RecordingError:
            refused += 1
    assert refused >= 3
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(RecordingError, match=r"the bag is corrupt.*`rosbag reindex`"):
        read_recording(path)


def test_a_folder_may_be_named_like_a_file(tmp_path: Path):
    assert len(read_recording(write_bag(tmp_path / "drive.mcap", recording()))) == FRAMES
