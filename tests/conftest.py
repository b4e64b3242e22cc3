"""What all tests share: settings, and skipping what this machine cannot do.

Nothing of quest is imported at module level: the jaxtyping hook must come first.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import beartype
import pytest
from hypothesis import settings

PARTNET_BESIDE_CHECKOUT = Path(__file__).parents[2] / "shared" / "data" / "partnet-mobility"

# For type checkers an int is a float (PEP 484); beartype agrees only when asked, and the hook of jaxtyping looks
# it up by this name.
beartype.beartype = beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))

# Derandomised: a test suite that fails once in a while teaches people to run it twice.
settings.register_profile("quest", deadline=None, derandomize=True, database=None, max_examples=50)
settings.load_profile("quest")


PLAIN = ("cli", "test_api_surface.py", "test_cli.py", "test_documented_names.py", "test_examples.py", "test_readme.py")
"""Tests of commands and documents: they pass no arrays themselves, so the shape checks have nothing to say to them."""


def is_unchecked(item: pytest.Item) -> bool:
    """Whether a test runs without the shape checks: it is dear, or plain, or expects our own errors.

    The checks raise before our own errors do.
    """
    code = getattr(getattr(item, "function", None), "__code__", None)
    expects_errors = code is not None and "raises" in code.co_names
    return expects_errors or any(item.get_closest_marker(name) for name in ("slow", "plain"))


@pytest.fixture(autouse=True)
def _shape_checks(request: pytest.FixtureRequest) -> Iterator[None]:
    """Every annotated shape is checked (``--jaxtyping-packages``), but in tests that :func:`is_unchecked` names."""
    import jaxtyping

    jaxtyping.config.update("jaxtyping_disable", is_unchecked(request.node))
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.hookimpl(tryfirst=True)  # before pytest-xdist reads the groups
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what is plain; keep on one worker what is dear to set up; skip what this machine cannot do.

    The first picture of a process compiles shaders for half a minute of processor time. What renders is the largest
    group, and begins first, so that no worker waits for it in the end.
    """
    no_objects = None if _partnet_root() else "no PartNet-Mobility objects: set QUEST_OBJECTS"
    no_renderer = _why_no_renderer() if any(item.get_closest_marker("render") for item in items) else None
    for item in items:
        if item.path.relative_to(Path(__file__).parent).parts[0] in PLAIN:
            item.add_marker("plain")
        if item.get_closest_marker("render") or "cluster" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.xdist_group("render"))
        if no_objects and item.get_closest_marker("partnet"):
            item.add_marker(pytest.mark.skip(reason=no_objects))
        if no_renderer and item.get_closest_marker("render"):
            item.add_marker(pytest.mark.skip(reason=no_renderer))
    items.sort(key=lambda item: item.get_closest_marker("xdist_group") is None)


@pytest.fixture(scope="session")
def partnet_root() -> Path:
    """Folder of PartNet-Mobility objects; the test is skipped without one."""
    root = _partnet_root()
    if root is None:
        pytest.skip("no PartNet-Mobility objects: set QUEST_OBJECTS")
    return root


@pytest.fixture(scope="session", autouse=True)
def _few_threads() -> None:
    """Several workers share the cores, so torch must not take all of them in each."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        import torch

        torch.set_num_threads(1)


def _partnet_root() -> Path | None:
    named = os.environ.get("QUEST_OBJECTS")
    root = Path(named) if named else PARTNET_BESIDE_CHECKOUT
    return root if root.is_dir() else None


def _why_no_renderer() -> str | None:
    from quest.errors import RendererError
    from quest.extras import is_installed
    from quest.render_device import find_vulkan_icd

    if not is_installed("sapien"):
        return "the sim extra is not installed"
    try:
        return None if find_vulkan_icd() else "no Vulkan driver can render here: `make render-deps`"
    except RendererError as error:
        return str(error)
