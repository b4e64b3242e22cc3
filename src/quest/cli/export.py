"""``quest export``: the tracker's networks as ONNX."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rich.table import Table

from quest.cli.console import Console
from quest.errors import ConfigError

if TYPE_CHECKING:
    from quest.model.onnx_export import Difference


@dataclass(frozen=True)
class Export:
    """Write the finder and the dense features as ONNX, with a manifest that says how to use them.

    They are compared with PyTorch on a picture of the packaged clip at two sizes; what differs by more than 1e-4 is not
    written. `quest track --engine FOLDER` runs them.
    """

    out: Path
    """Folder for finder.onnx, features.onnx and manifest.json; it must be empty if it is there."""
    weights: str = "quest-s16"
    """Name of shipped weights, a file, or owner/name on the Hugging Face hub."""

    def run(self) -> int:
        """Export, compare, write."""
        console = Console()
        console.print(f"exporting {self.weights}; this takes a minute or more")
        from quest.model.onnx_export import TOLERANCE, require_empty
        from quest.model.weights import find_weights, load_network
        from quest.paper.network import is_paper
        from quest.track.engine import export

        require_empty(self.out)
        if is_paper(find_weights(self.weights)):
            raise ConfigError(f"export: {self.weights} is the published network, which has no export; use the finder's")
        differences = export(load_network(self.weights), self.out)
        console.print(_table(differences))
        console.print(f"all within {TOLERANCE:.0e}; extents relative to their size, all else absolute")
        console.print(f"wrote {self.out}: finder.onnx, features.onnx, manifest.json")
        return 0


def _table(differences: list[Difference]) -> Table:
    """The largest difference of every output at every size."""
    table = Table(title="largest difference from PyTorch", title_justify="left", box=None, header_style="dim")
    for column in ("network", "output", "picture"):
        table.add_column(column)
    table.add_column("difference", justify="right")
    for each in differences:
        width, height = each.size
        table.add_row(each.network, each.output, f"{width} x {height}", f"{each.largest:.1e}")
    return table
