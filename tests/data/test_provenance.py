"""Which commit and command a result says it is of."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
from pathlib import Path

import pytest

from quest.data import provenance


def test_other_results_do_not_make_a_commit_dirty_but_code_does(tmp_path: Path):
    code, result = tmp_path / "src" / "provenance.py", tmp_path / "benchmarks" / "results" / "one.json"
    for file in (code, result):
        file.parent.mkdir(parents=True)
    shutil.copy(provenance.__file__, code)
    result.write_text("{}")
    who = ("-c", "user.name=somebody", "-c", "user.email=somebody@example.org")
    for arguments in (("init", "-q"), ("add", "-A"), (*who, "commit", "-q", "-m", "first")):
        subprocess.run(["git", *arguments], cwd=tmp_path, check=True)
    spec = importlib.util.spec_from_file_location("copied_provenance", code)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    commit = module.code_commit()
    assert len(commit) == 40
    result.write_text("{1}")
    assert module.code_commit() == commit
    code.write_text(code.read_text() + "\n")
    assert module.code_commit() == commit + "+dirty"


@pytest.mark.parametrize("shard", [[], ["--shard", "1/2"], ["--shard=1/2"]])
def test_the_command_of_a_result_is_that_of_all_shards(shard: list[str], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("sys.argv", ["/bin/quest", "eval", *shard, "--takes", "my takes", "--out", "a.json"])
    assert provenance.command_line() == "quest eval --takes 'my takes' --out a.json"
