"""Arguments that the commands share which follow entities in a recording or a take."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from quest.cli.console import Console
from quest.cli.progress import counting
from quest.data.frame_source import FrameSource, Parts
from quest.data.queries_file import read_queries
from quest.errors import ConfigError, InputError, RecordingError
from quest.monitor import Budget, Inputs
from quest.types import Clip, Query
from quest.wording import counted

if TYPE_CHECKING:
    from quest.track import Tracker


@dataclass(frozen=True)
class Source:
    """The recording, the queries, and the weights."""

    clip: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RECORDING")]
    """A video, a folder of images, a recording folder, an MCAP file, a ROS bag, a LeRobot v3 dataset, a take
    (STORE/NAME.zarr), a live camera (camera:0, camera:rtsp://ADDRESS, realsense) for quest live and quest monitor, or
    the word sample or sample-alarm for a clip that ships."""
    weights: str = "quest-s16"
    """Name of shipped weights or a file."""
    monitor: Path | None = None
    """File of `quest calibrate`; default: the monitor's calibrations that ship."""
    point: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """An entity by pixel, as FRAME,X,Y or FRAME,X,Y,NAME; give it again for each entity."""
    label: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """The most confident entity of a label: handle, knob, rim or front; for one intent only, such as rim:lift or
    rim:open; give it again for more."""
    text: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """An entity in words, such as "the lever of the left door"; give it again for each entity."""
    queries_file: Annotated[Path | None, tyro.conf.arg(name="queries", metavar="FILE")] = None
    """File of queries, as `quest pick` saves it; those that are given otherwise are added."""
    online: bool = False
    """Without queries: discover entities in later frames too, not in the first one alone."""
    depth: Path | None = None
    """Folder of 16-bit depth images; default: depth beside the colours."""
    camera: Path | None = None
    """Camera file; default: the recording's own, such as camera.json beside the colours."""
    depth_scale_m: float | None = None
    """Metres per unit of 16-bit depth; default: that of the camera file, in bags millimetres."""
    fov: Annotated[float | None, tyro.conf.arg(metavar="DEGREES")] = None
    """Field of view across the longer side of the image, for colours without a camera file; default: a focal length as
    long as that side, which is 53 degrees."""
    parts: tyro.conf.OmitArgPrefixes[Parts] = Parts()
    """Which parts of a take, a LeRobot dataset or a bag to read."""
    device: str = "auto"
    """cpu, cuda, mps or auto."""
    engine: str = "torch"
    """What runs the networks: torch; bfloat16, faster where the device has it; onnx, which is ONNX Runtime on the
    processor; or a folder of quest export."""
    alpha: float = 0.05
    """Share of streams without any loss that may raise an alarm."""
    alpha_frames: int | None = None
    """--alpha is for every so many frames instead, such as 300, so that alarms come as readily late as early; default:
    for the whole recording, and of a live camera for every block of the calibration."""

    def open(self) -> FrameSource:
        """The recording or the view of a take, to be read frame by frame; errors of :func:`open_recording`."""
        from quest.data.recording import open_recording

        return open_recording(
            self.clip,
            depth=self.depth,
            camera=self.camera,
            depth_scale_m=self.depth_scale_m,
            fov_deg=self.fov,
            parts=self.parts,
        )

    def read(self, console: Console) -> Clip:
        """All frames in memory; degradations are printed on standard error.

        Raises:
            RecordingError: as in :meth:`open`, or the frames do not fit into memory.
        """
        source = self.open()
        _check_memory(source)
        return read_saying(source, console)

    def queries(self, clip: Clip | FrameSource) -> list[Query] | None:
        """The queries about a clip; None where there are none, and entities are to be discovered.

        Raises:
            InputError: a point or label is not written as expected, or its frame is beyond the end of the clip.
        """
        length = len(clip) if isinstance(clip, Clip) else clip.length
        queries = [] if self.queries_file is None else read_queries(self.queries_file)
        for query in queries:
            _check_frame(f"--queries {self.queries_file}: expected frames", query.frame, length)
        for text in self.point:
            parts = text.split(",", 3)
            try:
                frame, x, y = int(parts[0]), float(parts[1]), float(parts[2])
            except (ValueError, IndexError) as error:
                raise InputError(
                    f"--point {text!r}: expected FRAME,X,Y or FRAME,X,Y,NAME, such as 0,120.5,88"
                ) from error
            _check_frame(f"--point {text!r}: expected a frame", frame, length)
            name = parts[3] if len(parts) > 3 else ""
            if any("\ud800" <= letter <= "\udfff" for letter in name):
                raise InputError(f"--point {text!r}: expected a name in UTF-8")
            queries.append(Query.point(frame, x, y, name=name))
        for text in self.label:
            label, _, intent = text.partition(":")
            queries.append(Query.semantic(label, intent=intent or None))
        queries += [Query.text(words) for words in self.text]
        return queries or None

    def check_alpha(self) -> None:
        """Raise ConfigError unless alpha is a probability, of some frames if it is of frames."""
        if not 0.0 < self.alpha < 1.0:
            raise ConfigError(f"--alpha {self.alpha}: expected a number between 0 and 1, such as 0.05")
        if self.alpha_frames is not None and self.alpha_frames < 1:
            raise ConfigError(f"--alpha-frames {self.alpha_frames}: expected at least 1 frame, such as 300")

    def budget(self, tracker: Tracker, source: FrameSource | None = None) -> Budget:
        """How often alarms may be false; a source without an end shares alpha among its parts alike."""
        blocks = [calibration.block_frames for calibration in tracker.calibrations.values()]
        endless = source is not None and source.live and blocks
        return Budget(self.alpha, max(blocks) if endless and self.alpha_frames is None else self.alpha_frames)

    def tracker(self) -> Tracker:
        """The tracker of the weights; errors of :func:`quest.load`."""
        from quest.track import load

        return load(self.weights, device=self.device, monitor=self.monitor or True, engine=self.engine)


def read_saying(source: FrameSource, console: Console) -> Clip:
    """All frames in memory; how far it is goes to the console, degradations to standard error."""
    with counting(console, "reading", source.length) as report:
        clip = source.clip(report=report)
    say_flags(source, Console(stderr=True))
    return clip


def say_flags(source: FrameSource, console: Console) -> None:
    """Print the degradations of a recording."""
    for flag in source.flags:
        console.note(f"{source.name}: {flag}")


def say_shortfall(
    tracker: Tracker, console: Console, budget: Budget, *, frames: int | None, inputs: Inputs | None = None
) -> None:
    """Print which alarms there will never be, if the monitor's calibration is too small for some.

    Length of the recording, and what its frames bring, are told where they are known.
    """
    for brings, calibration in tracker.calibrations.items():
        if inputs in (None, brings) and (why := calibration.shortfall(budget, frames=frames)):
            console.note(f"monitor, {brings}: {why}; `quest calibrate`")


def _check_frame(expected: str, frame: int, length: int | None) -> None:
    if length is not None and frame >= length:
        raise InputError(f"{expected} of the clip, 0 to {length - 1}, got {frame}")


def _check_memory(source: FrameSource) -> None:
    """Raise RecordingError if all frames at once would need more memory than there is."""
    free_bytes = _free_bytes()
    if free_bytes is None or source.length is None:
        return
    camera = source.camera
    need_bytes = 2 * 3 * source.length * camera.width * camera.height  # each picture alone, and then all together
    if need_bytes > free_bytes:
        raise RecordingError(
            f"recording {source.name}: {counted(source.length, 'frame')} of {camera.width} x {camera.height} need "
            f"{need_bytes / 1e9:.1f} GB of memory, {free_bytes / 1e9:.1f} GB are free; make it shorter or smaller "
            f"(ffmpeg -i IN -vf scale=640:-2 OUT.mp4), or use `quest monitor`, which keeps no frames"
        )


def _free_bytes() -> int | None:
    """Memory that is free; None where the system does not say."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")), None)
