"""What colcon needs is there, and names agree: manifests, build files, resource marker, launch file, parameters."""

from __future__ import annotations

import ast
import configparser
import importlib.util
import re
import subprocess
import sys
import tomllib
from collections import Counter
from dataclasses import fields
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml
from quest_ros.settings import Settings

from tests.ros.fake_rclpy import install_launch
from tests.ros.ros_types import MESSAGES, ROOT, types_of

NODE = ROOT / "quest_ros"
PAGE = ROOT.parent / "docs" / "ros.md"
OURS = {"quest", "quest_ros"}
BY_PIP = {"numpy", "jaxtyping"}


def manifest(package: Path) -> ElementTree.Element:
    return ElementTree.parse(package / "package.xml").getroot()


@pytest.mark.parametrize(("package", "build_type"), [(MESSAGES, "ament_cmake"), (NODE, "ament_python")])
def test_manifests(package: Path, build_type: str):
    root = manifest(package)
    assert root.get("format") == "3"
    assert root.findtext("name") == package.name
    assert root.findtext("export/build_type") == build_type
    assert re.fullmatch(r"\d+\.\d+\.\d+", root.findtext("version") or "")
    assert root.findtext("license") == tomllib.loads((ROOT.parent / "pyproject.toml").read_text())["project"]["license"]
    maintainer = root.find("maintainer")
    assert maintainer is not None
    assert "@" in maintainer.get("email", "")
    assert all(root.findtext(name) for name in ("description", "license"))
    assert max(Counter((each.tag, each.text) for each in root if each.tag.endswith("depend")).values()) == 1


def test_the_build_file_names_every_definition_and_package():
    text = (MESSAGES / "CMakeLists.txt").read_text()
    named = set(re.findall(r'"(\w+/\w+\.\w+)"', text))
    assert named == {path.relative_to(MESSAGES).as_posix() for path in MESSAGES.glob("*/*.???")}
    used = set(re.findall(r"^(\w+)/", "\n".join(path.read_text() for path in MESSAGES.glob("*/*.???")), re.MULTILINE))
    found = set(re.findall(r"find_package\((\w+)", text))
    declared = {each.text for each in manifest(MESSAGES) if each.tag.endswith("depend")}
    assert used <= found <= declared
    assert manifest(MESSAGES).findtext("member_of_group") == "rosidl_interface_packages"


def test_every_field_is_described():
    for path in sorted(MESSAGES.glob("*/*.???")):
        block = False
        for line in path.read_text().splitlines():
            if line.startswith("#") or not line or line == "---":
                block = line.startswith("#")
            elif "=" not in line:
                assert block, f"{path.name}: {line} has no comment above it"


def test_the_node_declares_what_it_imports():
    declared = {each.text for each in manifest(NODE) if each.tag == "exec_depend"}
    imported = set()
    for path in [*NODE.glob("quest_ros/*.py"), *NODE.glob("launch/*.py")]:
        for node in ast.walk(ast.parse(path.read_text(), feature_version=(3, 10))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            imported |= {name.partition(".")[0] for name in names}
    named = set(re.findall(r'"(\w+)/(?:msg|srv)/', "".join(path.read_text() for path in NODE.glob("quest_ros/*.py"))))
    needed = {"python3-yaml" if name == "yaml" else name for name in imported | named} - OURS - BY_PIP
    assert needed - set(sys.stdlib_module_names) <= declared


def test_only_the_node_needs_ros():
    for path in NODE.glob("quest_ros/*.py"):
        assert ("rclpy" in path.read_text()) == (path.name == "node.py")


@pytest.mark.slow
def test_it_installs_where_ros_looks(tmp_path: Path):
    command = ["egg_info", "--egg-base", tmp_path, "build", "--build-base", tmp_path / "build", "install"]
    options = ["--prefix", tmp_path / "to", "--record", tmp_path / "files", "--single-version-externally-managed"]
    run = [sys.executable, "-W", "ignore", "setup.py", "-q", *command, *options]
    subprocess.run([str(part) for part in run], cwd=NODE, check=True, capture_output=True)
    installed = {path.relative_to(tmp_path / "to").as_posix() for path in (tmp_path / "to").rglob("*")}
    share = {"package.xml", "launch/track.launch.py", "config/track.yaml"}
    assert {f"share/quest_ros/{name}" for name in share} <= installed
    assert "share/ament_index/resource_index/packages/quest_ros" in installed
    script = (tmp_path / "to/lib/quest_ros/track").read_text()
    assert script.startswith("#!/usr/bin/env python3\n")
    assert any(name.endswith("quest_ros/node.py") for name in installed)


def test_the_entry_point_exists():
    tree = ast.parse((NODE / "setup.py").read_text())
    module, name = re.findall(r"= \{NAME\}\.(\w+):(\w+)", ast.unparse(tree))[0]
    functions = ast.parse((NODE / "quest_ros" / f"{module}.py").read_text()).body
    assert name in {node.name for node in functions if isinstance(node, ast.FunctionDef)}
    config = configparser.ConfigParser()
    config.read(NODE / "setup.cfg")
    assert config["install"]["install_scripts"] == "$base/lib/quest_ros"


def test_parameters_of_the_file_are_those_of_the_node_with_their_defaults():
    given = yaml.safe_load((NODE / "config" / "track.yaml").read_text())["/**"]["ros__parameters"]
    assert list(given) == [field.name for field in fields(Settings)]
    assert Settings.from_parameters(given) == Settings()


@pytest.fixture
def launched(monkeypatch: pytest.MonkeyPatch) -> Any:
    install_launch(monkeypatch)
    spec = importlib.util.spec_from_file_location("track_launch", NODE / "launch" / "track.launch.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_launch_file_names_what_there_is(launched: Any):
    (actions,) = launched.generate_launch_description().args
    arguments = {action.args[0]: action.default_value for action in actions[:-1]}
    assert {"name", "params_file", *launched.TOPICS, *launched.PARAMETERS} == arguments.keys()
    assert set(launched.PARAMETERS) == {field.name for field in fields(Settings)} | {"use_sim_time"}
    share, *rest = arguments.pop("params_file").args[0]
    assert (share.args, (NODE / Path(*rest)).is_file()) == (("quest_ros",), True)
    topics = r'(?:resolve_topic_name\(|create_subscription\(CameraInfo, )"(\w+)"'
    subscribed = set(re.findall(topics, (NODE / "quest_ros" / "node.py").read_text()))
    assert subscribed == launched.TOPICS.keys()
    given = {**arguments, "labels": "[handle, 'rim:lift']", "use_depth": "false", "online_s": "1"}
    (node,) = actions[-1].function(given)
    assert (node.package, node.executable) == ("quest_ros", "track")
    assert f"{node.executable} = " in (NODE / "setup.py").read_text()
    assert node.parameters[1] == {"labels": ["handle", "rim:lift"], "use_depth": False, "online_s": 1}
    assert [name for name, _ in node.remappings] == list(launched.TOPICS)
    assert len(actions[-1].function(arguments)[0].parameters) == 1


def test_the_page_names_every_parameter_topic_service_and_field():
    page = PAGE.read_text()
    names = {field.name for field in fields(Settings)} | {path.stem for path in MESSAGES.glob("*/*.???")}
    names |= set(re.findall(r'"(~/\w+|/diagnostics)"', (NODE / "quest_ros" / "node.py").read_text()))
    assert not [name for name in sorted(names) if name not in page]
    assert types_of("jazzy")("quest_msgs/msg/Tracks")
