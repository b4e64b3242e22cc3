"""Weights that tests of commands share."""

from __future__ import annotations

import pytest


@pytest.fixture(scope="session")
def weights(tmp_path_factory: pytest.TempPathFactory) -> str:
    """File of untrained weights whose tracker takes whatever is found."""
    from quest.model.weights import save_network
    from tests.tiny import make_finder
    from tests.track.clips import EAGER

    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    save_network(path, make_finder(), settings=EAGER.to_json(), about="a test")
    return str(path)
