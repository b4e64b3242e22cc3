"""Rows of real recordings as tables in the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby

from rich.console import Group, RenderableType
from rich.text import Text

from quest.evaluation.real.run import RealRow
from quest.evaluation.tables import Column, columns_table

COLUMNS = (
    Column("median_px", "med px", 1, 1.0, 0),
    Column("within_16", "≤16 px %", 1, 100.0, 0),
    Column("moved_median_px", "moved: med px", 1, 1.0, 6),
    Column("moved_within_16", "moved: ≤16 %", 1, 100.0, 2),
    Column("never_beyond_50", "never >50 %", 0, 100.0, 7),
    Column("identity_errors", "id errors %", 1, 100.0, 3),
    Column("hidden_called_visible", "hidden seen %", 0, 100.0, 2),
    Column("occluded_called_visible", "occl. seen %", 0, 100.0, 9),
    Column("out_called_visible", "out seen %", 0, 100.0, 8),
    Column("lost_p_near", "P(lost) near", 3, 1.0, 5),
    Column("lost_p_far", "far", 3, 1.0, 4),
    Column("lost_p_hidden", "hidden", 3, 1.0, 4),
    Column("lost_auroc", "AUROC", 2, 1.0, 3),
    Column("recall", "recall %", 1, 100.0, 0),
    Column("precision", "prec. %", 1, 100.0, 0),
    Column("f1", "F1 %", 1, 100.0, 0),
    Column("ap", "AP", 3, 1.0, 1),
    Column("recall_0_to_16_px", "<16 px", 0, 100.0, 2),
    Column("recall_16_to_32_px", "16–32", 0, 100.0, 2),
    Column("recall_32_to_64_px", "32–64", 0, 100.0, 2),
    Column("recall_above_64_px", ">64", 0, 100.0, 2),
    Column("ap50_handle", "AP50 handle", 3, 1.0, 3),
    Column("ap50_cabinet", "cabinet", 3, 1.0, 4),
    Column("ap50_door", "door", 3, 1.0, 4),
    Column("ap50_refrigerator", "refrig.", 3, 1.0, 4),
    Column("ap50_bare", "bare", 3, 1.0, 4),
)
"""What is shown of a row, in this order; the result file has everything."""

FULL_WIDTH = 220
"""Enough for every column; for output that goes to a file."""
LEGEND = (
    "below each number the 95 % bootstrap interval over clips (pictures). n: clips/tracks/labels after the first, or "
    "pictures/handles/answers. Medians below 3 px rank nobody: labels are no better"
)


def real_table(
    sets: Mapping[str, Sequence[RealRow]],
    *,
    width: int = FULL_WIDTH,
    shown: Sequence[Column] = COLUMNS,
    legend: str = LEGEND,
) -> RenderableType:
    """One table per set and kind of row.

    Columns that do not fit into the width, in characters, are left out whole, as are those without numbers.
    """
    tables = []
    for name, rows in sets.items():
        for of, group in groupby(rows, key=lambda row: row.of):
            heads = [((r.tracker, r.inputs, f"{r.units}/{r.targets}/{r.terms}"), r.measures) for r in group]
            tables.append(columns_table(f"{name} · {of}", ("tracker", "shown", "n"), heads, shown, width))
    return Group(*tables, Text(legend, style="dim"))
