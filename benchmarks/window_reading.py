"""Measure how fast random training windows come from a store: colour, depth, masks and truth of a few frames.

    quest generate --out runs/windows --procedural 4
    python benchmarks/window_reading.py runs/windows --out benchmarks/results/speed/windows.json

Beside it stand the same windows through ``TakeStore.read``, and reads of the very bytes that the windows need without
decoding them. The files are read once before, so that all readers find them in the page cache. Let nothing else run
meanwhile; the load is noted.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console

from quest.data.provenance import combined_hash
from quest.data.store import TakeStore
from quest.data.window_reader import Window, WindowReader
from quest.evaluation.report import provenance, write_report

_BATCH = 32


@dataclass(frozen=True)
class WindowReading:
    """Frames per second of random training windows from a store on a local disk."""

    store: Annotated[Path, tyro.conf.Positional]
    """Folder of takes."""
    frames: int = 4
    """Frames of a window."""
    windows: int = 1920
    """Windows that each reader reads."""
    threads: tuple[int, ...] = (1, 2)
    """Numbers of threads to measure."""
    repeats: int = 5
    """How often each reader is timed; the readers take turns."""
    seed: int = 0
    """Of the choice of windows."""
    out: Path | None = None
    """Result file."""

    def run(self) -> int:
        """Time every reader and print frames per second: the median, the least and the most."""
        store = TakeStore(self.store)
        headers = {name: h for name, h in store.headers().items() if h.frames >= self.frames}
        rng, names = np.random.default_rng(self.seed), sorted(headers)
        windows = []
        for _ in range(self.windows // _BATCH * _BATCH):
            name = names[rng.integers(len(names))]
            start = int(rng.integers(headers[name].frames - self.frames + 1))
            windows.append(Window(name, int(rng.integers(len(headers[name].cameras))), start, self.frames))
        readers = {f"windows_{n}_threads": self._reader(store, n) for n in self.threads}
        readers["raw_bytes_1_thread"] = self._raw(store)
        few = windows[:: max(1, len(windows) // 160)]
        readers["take_store_1_thread"] = lambda _: self._plain(store)(few)
        rates: dict[str, list[tuple[float, float]]] = {key: [] for key in readers}
        for read in readers.values():
            read(windows)
        for _ in range(self.repeats):
            for key, read in readers.items():
                rates[key].append(self._time(read, few if key == "take_store_1_thread" else windows))
        result = provenance() | {
            "frames_per_s": {key: _spread([wall for wall, _ in r]) for key, r in rates.items()},
            "frames_per_cpu_s": {key: _spread([cpu for _, cpu in r]) for key, r in rates.items()},
            "n_windows": len(windows),
            "frames_per_window": self.frames,
            "n_takes": len(names),
            "n_repeats": self.repeats,
            "data_hash": combined_hash((name, header.data_hash) for name, header in headers.items()),
            "load": os.getloadavg()[0],
        }
        Console().print_json(data=result)
        if self.out is not None:
            write_report(result, self.out)
        return 0

    def _time(self, read: Callable[[list[Window]], None], windows: list[Window]) -> tuple[float, float]:
        """Frames per second, and per second that a processor worked: the latter hardly depends on the load."""
        wall, cpu = time.perf_counter(), time.process_time()
        read(windows)
        frames = len(windows) * self.frames
        return frames / (time.perf_counter() - wall), frames / (time.process_time() - cpu)

    @staticmethod
    def _reader(store: TakeStore, threads: int) -> Callable[[list[Window]], None]:
        reader = WindowReader(store, threads=threads)

        def read(windows: list[Window]) -> None:
            for start in range(0, len(windows), _BATCH):
                reader.batch(windows[start : start + _BATCH])

        return read

    @staticmethod
    def _plain(store: TakeStore) -> Callable[[list[Window]], None]:
        def read(windows: list[Window]) -> None:
            for w in windows:
                store.read(w.take, views=[w.view], frames=slice(w.start, w.start + w.frames))

        return read

    @staticmethod
    def _raw(store: TakeStore) -> Callable[[list[Window]], None]:
        reader = WindowReader(store)

        def read(windows: list[Window]) -> None:
            for window in windows:
                for path, begin, size in reader.byte_ranges(window):
                    with path.open("rb", buffering=0) as file:
                        file.seek(begin)
                        file.read(size)

        return read


def _spread(rates: list[float]) -> dict[str, float]:
    return {"median": float(np.median(rates)), "least": min(rates), "most": max(rates)}


if __name__ == "__main__":
    raise SystemExit(tyro.cli(WindowReading).run())
