"""The node's package is no part of the distribution: its folder is put where Python looks for packages."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from quest.track import Tracker

sys.path.insert(0, str(Path(__file__).parents[2] / "quest_ros" / "quest_ros"))


@pytest.fixture(scope="session")
def tracker() -> Tracker:
    from quest.track import load

    return load("quest-s16", device="cpu")
