"""Rows over seeds, their differences, and the encoder whose answers are kept."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from quest.bench.rows import Answers, rows_of
from quest.bench.workbench import serve_cached
from quest.errors import InputError
from quest.evaluation.records import EntityRecord
from tests.evaluation.answers import make_answer
from tests.paper.tiny import make_paper

SETTINGS = {"resamples": 200, "seed": 0}
OBJECTS = ("desk-102015", "chest-102016", "safe-102017")


def answers(rng: np.random.Generator, *, first_frame: int = 2, **about) -> tuple[EntityRecord, ...]:
    return tuple(
        make_answer(
            rng.uniform(0, 1, 10),
            object_id=name,
            entity=entity,
            first_frame=first_frame,
            follows=rng.integers(1, 3, 10),
            moved=entity == 1,
            **about,
        )
        for name in OBJECTS
        for entity in (1, 2)
    )


def row(rows: list[dict[str, Any]], line: str, reading: str = "all") -> dict[str, Any]:
    return next(r for r in rows if (r["line"], r["reading"]) == (line, reading))


def test_means_and_differences_equal_a_plain_loop() -> None:
    rng = np.random.default_rng(0)
    full, less = ({s: answers(rng) for s in (0, 1)} for _ in range(2))
    runs = [Answers("full", s, r) for s, r in full.items()]
    runs += [Answers("less", s, r, reference="full") for s, r in less.items()]
    rows = rows_of(runs, **SETTINGS)
    for reading in ("all", "moved"):
        both = []
        for variant, records in (("full", full), ("less", less)):
            kept = [r for each in records.values() for r in each if reading == "all" or r.moved]
            ape = np.mean(np.concatenate([r.distance[2:].astype(np.float64) for r in kept]))
            acc = np.mean(np.concatenate([r.follows[2:] == r.entity for r in kept]))
            both.append((ape, np.mean([float(r.distance[-1]) for r in kept]), acc))
            metrics = row(rows, variant, reading)["metrics"]
            np.testing.assert_allclose([metrics[name].mean for name in ("ape", "d100", "acc")], both[-1])
        gap = row(rows, "less", reading)["difference"]
        found = [gap[name].mean for name in ("ape", "d100", "acc")]
        np.testing.assert_allclose(found, np.subtract(both[1], both[0]), atol=1e-12)
        assert gap["ape"].low <= gap["ape"].mean <= gap["ape"].high
    whole = row(rows, "full")
    assert whole["difference"] is None
    assert (whole["objects"], whole["tracks"]) == (3, 6)  # a track counts once for both seeds
    assert [each["seed"] for each in whole["seeds"]] == [0, 1]
    np.testing.assert_allclose(whole["seeds"][0]["ape"], np.mean([r.distance[2:].astype(float) for r in full[0]]))


def test_an_equal_answer_differs_by_nothing_with_certainty() -> None:
    records = answers(np.random.default_rng(0))
    rows = rows_of([Answers("full", 0, records), Answers("same", 0, records, reference="full")], **SETTINGS)
    gap = row(rows, "same")["difference"]["ape"]
    assert (gap.mean, gap.low, gap.high) == (0.0, 0.0, 0.0)


def test_only_common_seeds_are_paired() -> None:
    rng = np.random.default_rng(0)
    full, less = answers(rng), answers(rng)
    one = [Answers("full", 0, full), Answers("less", 0, less, reference="full")]
    more = [*one, Answers("full", 7, answers(rng))]
    a, b = (row(rows_of(runs, **SETTINGS), "less")["difference"] for runs in (one, more))
    assert a == b
    apart = [Answers("full", 0, full), Answers("less", 1, less, reference="full")]
    assert row(rows_of(apart, **SETTINGS), "less")["difference"] is None


def test_what_does_not_belong_together_is_refused() -> None:
    rng = np.random.default_rng(0)
    full = Answers("full", 0, answers(rng))
    with pytest.raises(InputError, match="twice"):
        rows_of([full, full], **SETTINGS)
    with pytest.raises(InputError, match="same entities"):
        rows_of([full, Answers("less", 0, answers(rng)[:-1], reference="full")], **SETTINGS)
    with pytest.raises(InputError, match="different frames"):
        rows_of([full, Answers("less", 0, answers(rng, first_frame=3), reference="full")], **SETTINGS)


def test_cached_encoder_reads_what_was_encoded(tmp_path: Path) -> None:
    rgb = torch.from_numpy(np.random.default_rng(0).integers(0, 256, (3, 64, 64, 3), dtype=np.uint8))
    network, plain = make_paper(), make_paper()
    serve_cached(network, tmp_path)
    encoded = network.encode(rgb[:2])
    torch.testing.assert_close(encoded, plain.encode(rgb[:2]).half().float())
    again, computed = make_paper(), []
    again.encoder.register_forward_hook(lambda *_: computed.append(1))
    serve_cached(again, tmp_path)
    assert torch.equal(again.encode(rgb[:2]), encoded)
    assert not computed
    again.encode(rgb)
    assert len(computed) == 1
    other = make_paper(seed=5)
    serve_cached(other, tmp_path)
    assert not torch.allclose(other.encode(rgb[:2]), encoded, atol=1e-3)
