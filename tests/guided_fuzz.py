"""Damage to files of one kind, guided by which lines of the readers it reaches: ``python -m tests.guided_fuzz KIND``.

Needs the package atheris, which ``make fuzz`` installs. What follows the kind goes to libFuzzer, such as
``-max_total_time=60`` (seconds) or a folder that keeps what reached new lines.
"""

from __future__ import annotations

import sys
import tempfile
from importlib import import_module
from pathlib import Path
from typing import Any


def main() -> None:
    """Fuzz one kind until libFuzzer ends."""
    atheris: Any = import_module("atheris")
    with atheris.instrument_imports(include=["quest"]):
        from tests.test_fuzz import KINDS, damaging

    kind, *rest = sys.argv[1:] or [""]
    if kind not in KINDS:
        sys.exit(f"expected a kind of file, one of {', '.join(KINDS)}; got {kind!r}")
    folder = Path(tempfile.mkdtemp(prefix="quest-fuzz-"))
    damage = damaging(kind, folder / "whole", folder / "damaged")
    atheris.Setup(
        [sys.argv[0], "-timeout=10", "-rss_limit_mb=4096", "-len_control=0", "-max_len=1024", *rest],
        damage.hypothesis.fuzz_one_input,
    )
    atheris.Fuzz()


if __name__ == "__main__":
    main()
