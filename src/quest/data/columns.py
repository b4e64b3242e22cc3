"""Columns of CSV files that people write: labels of pictures and clips."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import csv

from quest.errors import InputError


def read_columns(path: Path, kinds: Mapping[str, type], **optional: type) -> dict[str, np.ndarray]:
    """Columns of a CSV file, each of ``str``, ``int`` or ``float``, of which some may be missing.

    Empty numbers are NaN, empty words and what is optional and missing are empty.

    Raises:
        InputError: no such file, a column is missing, or a value is of another kind.
    """
    if not path.is_file():
        raise InputError(f"labels {path}: no such file; expected one with columns {', '.join(kinds)}")
    types = {str: pa.string(), int: pa.int64(), float: pa.float64()}
    wanted = {key: types[kind] for key, kind in {**kinds, **optional}.items()}
    convert = csv.ConvertOptions(column_types=wanted, include_columns=list(wanted), include_missing_columns=True)
    try:
        missing = sorted(set(kinds) - set(csv.open_csv(path).schema.names))
        if missing:
            raise InputError(f"{path}: expected columns {', '.join(kinds)}, got none named {', '.join(missing)}")
        table = csv.read_csv(path, csv.ReadOptions(use_threads=False), convert_options=convert)
    except pa.ArrowInvalid as error:
        raise InputError(f"{path}: cannot be read ({error})") from error
    fill = {pa.string(): "", pa.int64(): -1, pa.float64(): np.nan}
    columns = {key: table[key].fill_null(fill[kind]).to_numpy() for key, kind in wanted.items()}
    return {key: c.astype(str) if wanted[key] == pa.string() else c for key, c in columns.items()}
