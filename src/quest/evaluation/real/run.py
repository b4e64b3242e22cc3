"""Ask trackers about sets of labelled real recordings, keep what they answer, and make rows of it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import UInt8
from scipy.special import logit

from quest.baselines import TRACKERS, ClipTracker, Inputs
from quest.evaluation.bootstrap import Value
from quest.evaluation.finished import KeptAnswers
from quest.evaluation.real.measures import (
    Answers,
    Measures,
    ScoredClip,
    ScoredPicture,
    discovery_measures,
    score_clip,
    score_picture,
    track_measures,
)
from quest.evaluation.real.sets import LabelledClip, Labels, Picture, RealSet
from quest.evaluation.results import Run
from quest.track import Tracker
from quest.types import Clip
from quest.whole_file import whole_file

FORMAT = 1
"""Version of the result file."""

WIDE_STEP_PX = 16.0
"""Clips whose points move farther than this from frame to frame (median) have rows of their own."""

T = TypeVar("T", bound=ClipTracker)
Progress = Callable[[str, int], None]


@dataclass(frozen=True)
class RealRow:
    """One tracker on a set, or on one clip or picture of it."""

    of: str
    """``tracks``, ``tracks, wide steps``, ``pictures``, or the name of the clip or picture."""
    tracker: str
    inputs: Inputs
    units: int
    """Clips or pictures."""
    targets: int
    """Tracks, or handles."""
    terms: int
    """Scored labels, or answers given."""
    measures: Measures


def evaluate_set(
    real: RealSet,
    trackers: Sequence[ClipTracker],
    *,
    resamples: int,
    seed: int,
    kept: KeptAnswers | None = None,
    progress: Progress = lambda doing, done: None,
) -> tuple[list[RealRow], list[RealRow]]:
    """Score trackers on a set.

    Args:
        real: the set.
        trackers: with names of the registry; those that cannot discover have no rows of pictures.
        resamples: of the bootstrap over clips or pictures.
        seed: of the bootstrap.
        kept: where answers are kept as they come; nowhere by default.
        progress: called before each clip and picture with what is being done, and how many were done since.

    Returns:
        Rows of the table, and rows of each clip and picture.

    Raises:
        InputError: a recording is damaged or does not fit its labels.
    """
    found: dict[tuple[str, str, Inputs], dict[str, Any]] = {}
    for clip in real.clips:
        of = "tracks, wide steps" if clip.labels.step_px > WIDE_STEP_PX else "tracks"
        for tracker, inputs, scored in _ask_clip(clip, trackers, kept, progress):
            found.setdefault((of, tracker, inputs), {})[clip.name] = scored
    for picture in real.pictures:
        for tracker, scored in _ask_picture(picture, trackers, kept, progress):
            found.setdefault(("pictures", tracker, "colours"), {})[picture.name] = scored

    def row(of: str, tracker: str, inputs: Inputs, scored: Sequence[Any], resamples: int) -> RealRow:
        if isinstance(scored[0], ScoredPicture):
            measures = discovery_measures(scored, resamples=resamples, seed=seed)
            counts = sum(len(p.found) for p in scored), sum(len(p.right) for p in scored)
        else:
            measures = track_measures(scored, far_px=real.far_px, resamples=resamples, seed=seed)
            tracks = (np.unique(c.labels.track[c.labels.scored]) for c in scored)
            counts = sum(map(len, tracks)), sum(len(c.error_px) for c in scored)
        return RealRow(of, tracker, inputs, len(scored), *counts, measures)

    rows, single = rows_of(found, row, resamples)
    return sorted(rows, key=lambda row: ("tracks", "tracks, wide steps", "pictures").index(row.of)), single


def rows_of(
    found: Mapping[tuple[str, str, Inputs], Mapping[str, Any]],
    row: Callable[[str, str, Inputs, Sequence[Any], int], RealRow],
    resamples: int,
) -> tuple[list[RealRow], list[RealRow]]:
    """A row of each table, tracker and input, of all that was scored there, and a row of each by its name."""
    rows = [row(*key, list(by_name.values()), resamples) for key, by_name in found.items()]
    return rows, [row(name, *key[1:], [one], 1) for key, by_name in found.items() for name, one in by_name.items()]


def shown(clip: Clip) -> dict[Inputs, Clip]:
    """A clip as trackers may be shown it: all of it, without poses, without depth."""
    still = np.tile(np.eye(4), (len(clip), 1, 1))
    ways: dict[Inputs, Clip] = {"colours": replace(clip, depth_m=None, cam_from_world=still)}
    if clip.depth_m is not None:
        ways["depth"] = replace(clip, cam_from_world=still)
        if len(clip) > 1 and (clip.cam_from_world != still).any():
            ways["depth and poses"] = clip
    return ways


def _ask_clip(
    clip: LabelledClip, trackers: Sequence[ClipTracker], kept: KeptAnswers | None, progress: Progress
) -> Iterator[tuple[str, Inputs, ScoredClip]]:
    recording = clip.read()
    labels, ways = clip.labels, shown(recording)
    diagonal_px = float(np.hypot(recording.camera.width, recording.camera.height))
    for tracker, inputs in asked(trackers, ways):
        progress(f"{clip.name}: {tracker.name}, {inputs}", 0)
        answers = kept_or_asked(kept, clip.name, tracker.name, inputs, partial(_follow, tracker, ways[inputs], labels))
        yield tracker.name, inputs, score_clip(labels, Answers(**answers), diagonal_px=diagonal_px)
    progress(clip.name, 1)


def _ask_picture(
    picture: Picture, trackers: Sequence[ClipTracker], kept: KeptAnswers | None, progress: Progress
) -> Iterator[tuple[str, ScoredPicture]]:
    rgb = picture.read()
    for tracker in trackers:
        if isinstance(tracker, Tracker) and "colours" in TRACKERS[tracker.name].inputs:
            progress(f"{picture.name}: {tracker.name}", 0)
            answers = kept_or_asked(kept, picture.name, tracker.name, "colours", partial(discover, tracker, rgb))
            yield tracker.name, score_picture(picture, answers)
    progress(picture.name, 1)


def asked(trackers: Sequence[T], ways: Mapping[Inputs, Clip]) -> Iterator[tuple[T, Inputs]]:
    """Every tracker with every way of showing it a clip that it has a row for."""
    for tracker in trackers:
        for inputs in TRACKERS[tracker.name].inputs:
            if inputs in ways:
                yield tracker, inputs


def kept_or_asked(
    kept: KeptAnswers | None, of: str, tracker: str, inputs: Inputs, ask: Callable[[], dict[str, np.ndarray]]
) -> dict[str, Any]:
    """What a tracker says of a clip or picture: what was kept, or what ``ask`` returns."""
    return dict(ask() if kept is None else kept.get(f"{of}.{tracker}.{inputs.replace(' ', '-')}", ask))


def _follow(tracker: ClipTracker, clip: Clip, labels: Labels) -> dict[str, np.ndarray]:
    """Answers at the scored labels."""
    tracks = tracker.track(clip, labels.queries())
    at = labels.frame[labels.scored], labels.track[labels.scored]
    lost_p = np.full(len(at[0]), np.nan) if tracks.lost_p is None else tracks.lost_p[at]
    return {"uv_px": tracks.uv_px[at], "visible": tracks.visible[at], "lost_p": lost_p}


def discover(tracker: Tracker, rgb: UInt8[np.ndarray, "H W 3"]) -> dict[str, np.ndarray]:
    """Handles, knobs, doors and drawers that a tracker finds in a picture.

    Returns:
        Best first, however unlikely: ``uv_px``, ``box_px`` and ``score`` (log odds of being right) of grips,
        ``panel_px``, ``panel_kind`` and ``panel_score`` of panels, ``bare_px`` and ``bare_score`` of panels that are
        taken hold of by their front or rim; and the ``least`` score that discovery follows.
    """
    found = tracker.find(rgb)
    grips, panels, least = found.select(~np.isnan(found.box_px[:, 0])), found.panels, tracker.config.threshold
    bare = found.select(np.isin(found.labels, ("rim", "front")) & (found.panel >= 0))
    return {
        "uv_px": grips.uv_px, "box_px": grips.box_px, "score": grips.logit, "panel_px": panels.box_px,
        "panel_kind": panels.kind, "panel_score": panels.logit, "bare_px": panels.box_px[bare.panel],
        "bare_score": bare.logit, "least": logit(least),
    }  # fmt: skip


def write_set(path: Path, name: str, rows: Sequence[RealRow], single: Sequence[RealRow], run: Run) -> None:
    """Write the result file of a set, whole or not at all.

    Of each clip and picture, in ``single``, only the numbers are kept.
    """
    raw = {
        "format": FORMAT,
        "set": name,
        "run": asdict(run),
        "rows": [{**asdict(row), "measures": {k: _value(v) for k, v in row.measures.items()}} for row in rows],
        "single": [
            {**asdict(row), "measures": {k: _short(v.mean) for k, v in row.measures.items() if v is not None}}
            for row in single
        ],
    }
    with whole_file(path) as unfinished:
        unfinished.write_text(_compact(raw), encoding="utf-8")


def _compact(raw: dict[str, Any]) -> str:
    """JSON with a line per row, so that files stay small and differences readable."""
    lists = {key: ",\n  ".join(json.dumps(row, allow_nan=False) for row in raw[key]) for key in ("rows", "single")}
    head = json.dumps({key: value for key, value in raw.items() if key not in lists}, indent=1, allow_nan=False)
    return head[:-2] + "".join(f',\n "{key}": [\n  {text}\n ]' for key, text in lists.items()) + "\n}\n"


def _value(value: Value | None) -> dict[str, Any] | None:
    return None if value is None else {key: _short(number) for key, number in asdict(value).items()}


def _short(number: float | None) -> float | None:
    """Five digits, of which no more than three mean anything."""
    return float(f"{number:.5g}") if isinstance(number, float) else number
