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


def test_nothing_to_find_says_what_to_install(tmp_path, monkeypatch):
    assert find(tmp_path) is None
    monkeypatch.setattr("quest.render_device.find_vulkan_icd", lambda: None)
    with pytest.raises(RendererError, match=r"make render-deps.*chromium libvulkan1.*VK_ICD_FILENAMES"):
        prepare_renderer()


NVIDIA = ("dev/nvidia0", "usr/lib/x86_64-linux-gnu/libGLX_nvidia.so.0", "etc/vulkan/icd.d/nvidia_icd.json")
LAVAPIPE = "usr/share/vulkan/icd.d/lvp_icd.x86_64.json"


@pytest.mark.parametrize(
    ("names", "api_version", "found"),
    [
        ([SWIFTSHADER], "1.3.0", ("swiftshader", SWIFTSHADER, False)),
        ([SWIFTSHADER, *NVIDIA], "1.3.0", ("nvidia", NVIDIA[2], True)),
        ([SWIFTSHADER, *NVIDIA[1:]], "1.3.0", ("swiftshader", SWIFTSHADER, False)),
        ([SWIFTSHADER, NVIDIA[0], NVIDIA[2]], "1.3.0", ("swiftshader", SWIFTSHADER, False)),
        ([NVIDIA[0], "usr/lib64/libGLX_nvidia.so.0", "usr/share/vulkan/icd.d/nvidia_icd.json"], "1.3.0",
         ("nvidia", "usr/share/vulkan/icd.d/nvidia_icd.json", True)),
        ([LAVAPIPE], "1.4.318", ("lavapipe", LAVAPIPE, False)),
        ([LAVAPIPE], "1.1.230", None),
        ([LAVAPIPE], "new", None),
    ],
)  # fmt: skip
def test_the_best_driver_is_found(tmp_path, names, api_version, found):
    for name in names:
        place(tmp_path, name, api_version=api_version)
    driver = find(tmp_path)
    expected = found and (found[0], str(tmp_path / found[1]), found[2])
    assert expected == (driver and (driver.kind, driver.icd, driver.on_gpu))


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
    assert os.environ["VK_ICD_FILENAMES"] == str(icd)


def test_known_warnings_of_the_driver_are_kept_back(capfd: pytest.CaptureFixture):
    """Native code writes past ``sys.stderr``."""
    known = b"../third_party/swiftshader/src/Vulkan/libVulkan.cpp:3965 WARNING: UNSUPPORTED: pNext sType = 1000212000\n"
    with without_known_warnings():
        os.write(2, known + b"device lost\n" + known)
    os.write(2, b"after\n")
    assert capfd.readouterr().err == "device lost\nafter\n"
