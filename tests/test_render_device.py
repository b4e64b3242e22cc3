import json
import os
import sys
from pathlib import Path

import pytest

from quest.errors import RendererError
from quest.render_device import find_vulkan_icd, prepare_renderer, without_known_warnings

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="other systems bring their own driver")

SWIFTSHADER = "usr/lib/chromium/vk_swiftshader_icd.json"


def place(root: Path, name: str, *, api_version: str = "1.3.0") -> Path:
    path = root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"ICD": {"library_path": "lib.so", "api_version": api_version}}))
    return path


def find(root: Path, **environ: str):
    return find_vulkan_icd(environ=environ, root=root)


def test_nothing_to_find(tmp_path):
    assert find(tmp_path) is None


def test_nothing_to_find_says_what_to_install(monkeypatch):
    monkeypatch.setattr("quest.render_device.find_vulkan_icd", lambda: None)
    with pytest.raises(RendererError, match=r"make render-deps.*chromium libvulkan1.*VK_ICD_FILENAMES"):
        prepare_renderer()


def test_swiftshader_of_chromium(tmp_path):
    icd = place(tmp_path, SWIFTSHADER)
    driver = find(tmp_path)
    assert driver is not None
    assert (driver.kind, driver.icd, driver.on_gpu) == ("swiftshader", str(icd), False)


def test_nvidia_comes_first(tmp_path):
    place(tmp_path, SWIFTSHADER)
    place(tmp_path, "dev/nvidia0")
    place(tmp_path, "usr/lib/x86_64-linux-gnu/libGLX_nvidia.so.0")
    icd = place(tmp_path, "etc/vulkan/icd.d/nvidia_icd.json")
    driver = find(tmp_path)
    assert driver is not None
    assert (driver.kind, driver.icd, driver.on_gpu) == ("nvidia", str(icd), True)


@pytest.mark.parametrize("missing", ["dev/nvidia0", "usr/lib64/libGLX_nvidia.so.0"])
def test_nvidia_needs_device_and_graphics_library(tmp_path, missing):
    for name in ("dev/nvidia0", "usr/lib64/libGLX_nvidia.so.0", "usr/share/vulkan/icd.d/nvidia_icd.json", SWIFTSHADER):
        if name != missing:
            place(tmp_path, name)
    driver = find(tmp_path)
    assert driver is not None
    assert driver.kind == "swiftshader"


@pytest.mark.parametrize(("api_version", "accepted"), [("1.1.230", False), ("1.4.318", True), ("new", False)])
def test_lavapipe_only_if_recent(tmp_path, api_version, accepted):
    place(tmp_path, "usr/share/vulkan/icd.d/lvp_icd.x86_64.json", api_version=api_version)
    driver = find(tmp_path)
    assert (driver is not None and driver.kind == "lavapipe") is accepted


@pytest.mark.parametrize("variable", ["VK_ICD_FILENAMES", "VK_DRIVER_FILES"])
def test_the_users_choice_wins(tmp_path, variable):
    place(tmp_path, SWIFTSHADER)
    own = place(tmp_path, "own.json")
    driver = find(tmp_path, **{variable: str(own)})
    assert driver is not None
    assert (driver.kind, driver.icd) == ("chosen", str(own))


def test_the_users_choice_must_exist(tmp_path):
    place(tmp_path, SWIFTSHADER)
    with pytest.raises(RendererError, match=r"VK_ICD_FILENAMES names .*gone\.json, which does not exist"):
        find(tmp_path, VK_ICD_FILENAMES=str(tmp_path / "gone.json"))


def test_prepare_sets_the_environment(tmp_path, monkeypatch):
    icd = place(tmp_path, SWIFTSHADER)
    found = find(tmp_path)
    monkeypatch.setattr("quest.render_device.find_vulkan_icd", lambda: found)
    monkeypatch.setenv("VK_ICD_FILENAMES", "")
    assert prepare_renderer() == found
    import os

    assert os.environ["VK_ICD_FILENAMES"] == str(icd)


def test_known_warnings_of_the_driver_are_kept_back(capfd: pytest.CaptureFixture):
    """Native code writes past ``sys.stderr``."""
    known = b"../third_party/swiftshader/src/Vulkan/libVulkan.cpp:3965 WARNING: UNSUPPORTED: pNext sType = 1000212000\n"
    with without_known_warnings():
        os.write(2, known + b"device lost\n" + known)
    os.write(2, b"after\n")
    assert capfd.readouterr().err == "device lost\nafter\n"
