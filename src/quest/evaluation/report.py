"""Reports: what they carry beside their numbers, and the files that keep them."""

from __future__ import annotations

import json
import os
import shlex
import sys
from collections.abc import Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch

from quest.data.provenance import code_commit, machine, package_versions
from quest.whole_file import whole_file


def provenance() -> dict[str, Any]:
    """What a report must carry to be made again: command, commit, machine, versions and time."""
    script, spec = Path(sys.argv[0]), sys.modules["__main__"].__spec__
    program = [f"{script.parent.name}/{script.name}"] if spec is None else ["-m", spec.name]
    return {
        "command": shlex.join(["python", *program, *sys.argv[1:]]),
        "commit": code_commit(),
        "machine": machine(),
        "versions": package_versions(),
        "stamp": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def write_report(report: Mapping[str, Any], path: Path) -> None:
    """Write a report of plain values and dataclasses as JSON, whole or not at all; its folder is made."""
    text = json.dumps(report, indent=1, allow_nan=False, default=asdict)
    with whole_file(path) as partial, partial.open("w", encoding="utf-8") as file:
        file.write(text + "\n")
        file.flush()
        os.fsync(file.fileno())


def device_name(device: torch.device) -> str:
    """What a network ran on, as people call it."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else device.type
