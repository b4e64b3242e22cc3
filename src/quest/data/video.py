"""Video files: decoding frame by frame, and writing H.264."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import av.error
import numpy as np
from av.container import InputContainer
from av.video.stream import VideoStream
from jaxtyping import Float, Shaped, UInt8, UInt16

from quest.errors import InputError, RecordingError
from quest.untrusted import require_file
from quest.whole_file import whole_file
from quest.wording import counted

SUFFIXES = (".mp4", ".mkv", ".mov", ".avi", ".webm", ".m4v")
"""Suffixes by which a video is recognised in a folder; any other that FFmpeg knows can be named explicitly."""


@dataclass(frozen=True)
class VideoInfo:
    """The header of a video."""

    width: int
    """Of the upright picture, pixels."""
    height: int
    """Of the upright picture, pixels."""
    frames: int
    """Number of frames that it declares; 0 where it does not tell."""
    frames_per_s: float
    """Nominal frame rate."""
    turns: int = 0
    """Quarter turns, against the clock, that make its pictures upright."""


def probe_video(path: Path) -> VideoInfo:
    """The header of a video.

    Raises:
        RecordingError: there is no such file, or it is not a video.
    """
    with _open(path) as container:
        stream = container.streams.video[0]
        try:
            first = next(container.decode(stream), None)  # only frames tell how they are turned
        except av.error.FFmpegError as error:
            raise _undecodable(path, 0, error) from error
        turns = 0 if first is None else _turns(first)
        width, height = (stream.height, stream.width) if turns % 2 else (stream.width, stream.height)
        return VideoInfo(width, height, stream.frames, float(stream.average_rate or 30), turns)


def play_video(
    path: Path, *, pixel_format: str = "rgb24", start_s: float = 0.0
) -> Iterator[tuple[Shaped[np.ndarray, "H W *C"], float]]:
    """Frames of a video one by one, upright, with their time in seconds from the first frame of the file.

    Args:
        path: the file.
        pixel_format: what FFmpeg calls the format to convert to: ``rgb24``, or ``gray12le`` for 12 bits in 16.
        start_s: frames before are omitted; without any the end must be where the file says.

    Raises:
        RecordingError: there is no such file, it cannot be decoded, has no frames, changes its size, or ends early.
    """
    number, shape, before, longest_s = 0, None, -np.inf, 0.0
    with _open(path) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        rate = float(stream.average_rate or 30)
        origin = float((stream.start_time or 0) * stream.time_base) if stream.time_base else 0.0
        try:
            if start_s > 0 and stream.time_base:
                container.seek(int((origin + start_s) / stream.time_base), stream=stream, backward=True)
            for frame in container.decode(stream):
                # Some containers keep no times, or times that run backwards: the nominal rate goes on instead.
                time_s = frame.time - origin if frame.time is not None else before + 1 / rate
                if time_s < before or time_s == -np.inf:
                    time_s = 0.0 if before == -np.inf else before + 1 / rate
                shown_s = float(frame.duration * frame.time_base) if frame.duration and frame.time_base else 0.0
                longest_s = max(longest_s, shown_s, 0.0 if before == -np.inf else time_s - before)
                before = time_s
                if time_s < start_s:
                    continue
                image = np.ascontiguousarray(np.rot90(frame.to_ndarray(format=pixel_format), _turns(frame)))
                if shape is not None and image.shape != shape:
                    raise RecordingError(
                        f"video {path}: the frame size changes within the video; split it or scale it to one size"
                    )
                shape, number = image.shape, number + 1
                yield image, time_s
        except av.error.FFmpegError as error:
            raise _undecodable(path, number, error) from error
        if number == 0:
            raise RecordingError(f"video {path}: expected at least one frame, got none; record it again")
        if start_s == 0:
            _check_whole(path, container, number, last_s=origin + before, frame_s=max(longest_s, 1 / rate))


def _turns(frame: av.VideoFrame) -> int:
    """Quarter turns, against the clock, that make a frame upright; other angles are left alone, as in OpenCV."""
    turns, rest = divmod(frame.rotation % 360, 90)
    return 0 if rest else turns


def _check_whole(path: Path, container: InputContainer, number: int, *, last_s: float, frame_s: float) -> None:
    """Raise RecordingError if a video lacks more than the frame or two that may never be shown."""
    declared = container.streams.video[0].frames
    if number < declared - 2:
        raise RecordingError(
            f"video {path}: ends after {number} of {declared} frames; the file is corrupt, copy or record it again"
        )
    declared_s = None if declared else _declared_s(container)
    if declared_s is not None and last_s + 3.5 * frame_s < declared_s:
        raise RecordingError(
            f"video {path}: ends after {last_s + frame_s:.2f} of {declared_s:.2f} s; the file is corrupt, "
            "copy or record it again"
        )


def _declared_s(container: InputContainer) -> float | None:
    """When the pictures of a Matroska or WebM file end, by its header; None if it does not tell.

    Of other formats FFmpeg only estimates it. That of the whole file may be the end of a longer sound.
    """
    if "matroska" not in container.format.name or container.duration is None:
        return None
    whole_s = container.duration / av.time_base
    tag = re.fullmatch(r"(\d+):(\d\d):(\d\d(?:\.\d+)?)", container.streams.video[0].metadata.get("DURATION", ""))
    if tag is not None:
        return min(whole_s, 3600 * int(tag[1]) + 60 * int(tag[2]) + float(tag[3]))
    return whole_s if len(container.streams) == 1 else None


def read_video(path: Path) -> tuple[UInt8[np.ndarray, "T H W 3"], Float[np.ndarray, " T"]]:
    """All frames of a video as RGB, and their times in seconds from the first.

    Raises:
        RecordingError: as :func:`play_video`.
    """
    frames, stamps = zip(*play_video(path), strict=True)
    return np.stack(frames), np.array(stamps, dtype=np.float64) - stamps[0]


@contextmanager
def _open(path: Path) -> Iterator[InputContainer]:
    require_file(path, RecordingError)
    try:
        # Resolved, because FFmpeg takes what precedes a colon for a protocol.
        container = av.open(str(path.resolve()), metadata_errors="replace")
    except av.error.FFmpegError as error:
        raise _undecodable(path, 0, error) from error
    with container:
        if not container.streams.video:
            raise RecordingError(f"video {path}: the file has no video stream; give a video of RGB frames")
        yield container


def _undecodable(path: Path, number: int, error: av.error.FFmpegError) -> RecordingError:
    where = f"after {counted(number, 'frame')}" if number else "at all"
    return RecordingError(
        f"video {path}: cannot be decoded {where} ({error.strerror}); "
        "the file is corrupt or not a video, copy or record it again"
    )


def frame_rate(stamp_s: Float[np.ndarray, " T"]) -> float:
    """Frames per second by their times in seconds; 30 where these do not tell."""
    seconds = float(stamp_s[-1] - stamp_s[0])
    return (len(stamp_s) - 1) / seconds if seconds > 0 else 30.0


def write_video(
    path: Path,
    frames: Iterable[UInt8[np.ndarray, "H W 3"]],
    *,
    frames_per_s: float | int,
    crf: int = 18,
    preset: str = "veryfast",
    keyframe_every: int | None = None,
) -> int:
    """Write RGB frames as H.264 (yuv420p, or yuv444p where a side is odd), all or nothing; returns their number.

    Args:
        path: file to write, by its suffix usually an MP4; replaced if it exists.
        frames: frames of one size.
        frames_per_s: frame rate.
        crf: x264's constant rate factor: 18 looks lossless, 23 is small.
        preset: x264's speed preset.
        keyframe_every: frames from one that stands alone to the next; few make random access fast and the file large.

    Raises:
        InputError: no frames came, or frames of different sizes.
    """
    options = {"crf": str(crf), "preset": preset}
    options |= {} if keyframe_every is None else {"g": str(keyframe_every)}
    return _encode(path, frames, frames_per_s, "libx264", options, ("rgb24", "yuv420p", "yuv444p"))


def write_depth_video(path: Path, codes: Iterable[UInt16[np.ndarray, "H W"]], *, frames_per_s: float | int) -> int:
    """Write pictures of twelve bits (0 to 4095) as HEVC without loss, otherwise as :func:`write_video`."""
    options = {"x265-params": "lossless=1:log-level=error", "preset": "ultrafast"}
    return _encode(path, codes, frames_per_s, "libx265", options, ("gray12le", "gray12le", "gray12le"))


def _encode(
    path: Path,
    frames: Iterable[np.ndarray],
    frames_per_s: float,
    encoder: str,
    options: dict[str, str],
    formats: tuple[str, str, str],
) -> int:
    """Write a video; ``formats`` are those of the pictures as they come, and in the file with even and odd sides."""
    source, even, odd = formats
    written, size = 0, None
    with whole_file(path) as partial:
        with av.open(str(partial.resolve()), "w") as container:
            rate = Fraction(float(frames_per_s)).limit_denominator(1001)
            stream = container.add_stream(encoder, rate=rate, options=options)
            assert isinstance(stream, VideoStream), encoder
            for frame in frames:
                if size is None:
                    size = frame.shape
                    stream.height, stream.width = size[:2]
                    stream.pix_fmt = odd if size[0] % 2 or size[1] % 2 else even
                if frame.shape != size:
                    raise InputError(f"video {path}: frame {written} is of shape {frame.shape}, the first was {size}")
                picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format=source)
                container.mux(stream.encode(picture))
                written += 1
            if written:
                container.mux(stream.encode(None))
        if not written:
            raise InputError(f"video {path}: expected at least one frame, got none")
    return written
