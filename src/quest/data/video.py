"""Video files: decoding to RGB frames, and writing H.264."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import av
import av.error
import numpy as np
from jaxtyping import Float, UInt8

from quest.errors import InputError, RecordingError

SUFFIXES = (".mp4", ".mkv", ".mov", ".avi", ".webm", ".m4v")
"""Suffixes by which a video is recognised in a folder; any other that FFmpeg knows can be named explicitly."""


def read_video(path: Path) -> tuple[UInt8[np.ndarray, "T H W 3"], Float[np.ndarray, " T"]]:
    """All frames of a video as RGB, and their times in seconds from the first.

    Raises:
        RecordingError: there is no such file, it cannot be decoded, has no frames, or ends early.
    """
    if not path.is_file():
        raise RecordingError(f"video {path}: no such file; check the path")
    frames, stamps = [], []
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise RecordingError(f"video {path}: the file has no video stream; give a video of RGB frames")
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            declared, rate = stream.frames, stream.average_rate
            for frame in container.decode(stream):
                frames.append(frame.to_ndarray(format="rgb24"))
                stamps.append(frame.time)
    except av.error.FFmpegError as error:
        where = f"after {len(frames)} frames" if frames else "at all"
        raise RecordingError(
            f"video {path}: cannot be decoded {where} ({error.strerror}); "
            "the file is torn or not a video, copy or record it again"
        ) from error
    if not frames:
        raise RecordingError(f"video {path}: expected at least one frame, got none; record it again")
    if len(frames) < declared - 2:  # containers may count a frame or two that are never shown
        raise RecordingError(
            f"video {path}: ends after {len(frames)} of {declared} frames; the file is torn, copy or record it again"
        )
    if len({frame.shape for frame in frames}) > 1:
        raise RecordingError(f"video {path}: the frame size changes within the video; split it or scale it to one size")
    return np.stack(frames), _stamps(stamps, rate)


def _stamps(stamps: list[float | None], rate: Fraction | None) -> np.ndarray:
    """Presentation times from the first frame; the nominal rate where there are none or they run backwards."""
    if None not in stamps:
        seconds = np.array(stamps, dtype=np.float64)
        if (np.diff(seconds) >= 0).all():
            return seconds - seconds[0]
    return np.arange(len(stamps)) / float(rate or 30)


def write_video(
    path: Path,
    frames: Iterable[UInt8[np.ndarray, "H W 3"]],
    *,
    frames_per_s: float | int,
    crf: int = 18,
    preset: str = "veryfast",
) -> int:
    """Write RGB frames as H.264 (yuv420p, or yuv444p where a side is odd), all or nothing; returns their number.

    Args:
        path: file to write, by its suffix usually an MP4; replaced if it exists.
        frames: frames of one size.
        frames_per_s: frame rate.
        crf: x264's constant rate factor: 18 looks lossless, 23 is small.
        preset: x264's speed preset.

    Raises:
        InputError: no frames came, or frames of different sizes.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.stem}.partial{path.suffix}")
    written, size = 0, None
    try:
        with av.open(str(partial), "w") as container:
            stream = container.add_stream(
                "libx264",
                rate=Fraction(float(frames_per_s)).limit_denominator(1001),
                options={"crf": str(crf), "preset": preset},
            )
            for frame in frames:
                if size is None:
                    size = frame.shape
                    stream.height, stream.width = size[:2]
                    stream.pix_fmt = "yuv444p" if size[0] % 2 or size[1] % 2 else "yuv420p"
                if frame.shape != size:
                    raise InputError(f"video {path}: frame {written} is of shape {frame.shape}, the first was {size}")
                container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")))
                written += 1
            if written:
                container.mux(stream.encode(None))
        if not written:
            raise InputError(f"video {path}: expected at least one frame, got none")
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
    return written
