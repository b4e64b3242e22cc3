"""The notebooks run from top to bottom, and are small in git."""

from __future__ import annotations

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

pytestmark = pytest.mark.plain

NOTEBOOKS = sorted((Path(__file__).parents[1] / "examples" / "notebooks").glob("*.ipynb"))
MOST_BYTES = 200_000
SHORTER = """
import quest
from quest.data.cut import cut_clip
quest.read = lambda name, whole=quest.read: cut_clip(whole(name), slice({frames}))
"""
"""Cell ahead of all others: the frames that a notebook names are enough to run it."""
FRAMES = {"first_tracks": 9, "live_stream": 38}


def test_there_are_notebooks():
    assert {path.name for path in NOTEBOOKS} >= {"first_tracks.ipynb", "live_stream.ipynb"}


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_outputs_in_git_are_small_and_of_one_run(path: Path):
    assert path.stat().st_size < MOST_BYTES, "give pictures as JPEG, and fewer of them"
    cells = [cell for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell.outputs]
    assert outputs
    assert not [o for o in outputs if o.output_type == "error" or o.get("name") == "stderr"]


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_run(path: Path, tmp_path: Path):
    notebook = nbformat.read(path, as_version=4)
    if path.stem in FRAMES:
        notebook.cells.insert(0, nbformat.v4.new_code_cell(SHORTER.format(frames=FRAMES[path.stem])))
    where = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(notebook, timeout=280, kernel_name="python3", resources=where).execute()
    assert not list(tmp_path.iterdir()), "a notebook leaves nothing behind"
