"""Make takes of every suite, over 500 of them, and verify every truth in them against the others.

    QUEST_OBJECTS=... python benchmarks/verify_suites.py runs/takes_of_all_suites \
        --out benchmarks/results/data/verify.json

Most takes are small or keep every third or fourth frame of their script: what is verified is the truth, not the speed.
Run it again to resume.
"""

from __future__ import annotations

import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

LARGE = (
    "--suite gripper --every 3 --mix broad --seeds 0..29",
    "--suite moving --every 3 --mix broad --seeds 500..529",
    "--suite shift --every 3 --mix broad --seeds 600..603",
    "--suite occlusion --hidden 30 --look-alike --every 3 --seeds 700..705",
    "--suite lockers --every 6 --procedural 2",
    "--suite noise --variant 5 structured-light stereo --every 3 --seeds 800..803",
)
SMALL = (
    "--split train --level 1",
    "--split validation --level 1 2",
    "--suite moving --mix broad --seeds 530..539",
    "--suite shift --mix broad --seeds 620..629",
    "--suite occlusion --hidden 20 --mix broad --seeds 720..739",
    "--suite noise --variant 10 stereo --mix broad --seeds 820..839",
    "--camera mixed --motion mixed --sensor stereo --physics --mix broad --seeds 900..979",
    "--motion mixed --overlap 0.4 --mix broad --seeds 1000..1079 --level 2",
    "--mix broad --seeds 1100..1159",
)
"""Arguments of `quest generate`: takes of 224 pixels, and of 128 pixels and every fourth frame."""


@dataclass(frozen=True)
class VerifySuites:
    """Takes of every suite, made and verified."""

    store: Annotated[str, tyro.conf.Positional]
    """Where the takes go."""
    out: Path | None = None
    """Result file."""

    def run(self) -> int:
        """Make what is missing, then verify; the exit code is that of `quest data verify`."""
        for words in [*LARGE, *(f"--size 128 --views 1 --every 4 {words}" for words in SMALL)]:
            self._quest("generate", "--out", self.store, *shlex.split(words))
        return self._quest("data", "verify", self.store, *(["--json", str(self.out)] if self.out else []))

    def _quest(self, *words: str) -> int:
        return subprocess.run([sys.executable, "-m", "quest.cli.main", *words], check=words[0] == "generate").returncode


if __name__ == "__main__":
    raise SystemExit(tyro.cli(VerifySuites).run())
