"""Video files: what their headers say of length and orientation, and names and words that FFmpeg stumbles over."""

from __future__ import annotations

from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from quest.data.lerobot_export import Episode, export_lerobot
from quest.data.recording import read_recording, write_recording
from quest.data.video import play_video, probe_video, read_video, write_video
from quest.errors import RecordingError
from tests.synthetic import make_take

FRAMES = 30
RGB = np.random.default_rng(0).integers(0, 256, (FRAMES, 6, 8, 3)).astype(np.uint8).repeat(8, axis=1).repeat(8, axis=2)


def write_with(path: Path, pictures: np.ndarray, *, turned: int = 0, silence_s: float = 0.0) -> Path:
    """A video whose header says by how much its pictures are to be turned, and which may have silence beside them."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        if turned and not hasattr(stream, "set_display_rotation"):
            pytest.skip("needs PyAV 18, which writes how pictures are to be turned")
        if turned:
            stream.set_display_rotation(turned)
        sound = container.add_stream("libopus", rate=48000) if silence_s else None
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode(None))
        if sound is not None:
            for k in range(int(50 * silence_s)):
                frame = av.AudioFrame.from_ndarray(np.zeros((1, 1920), np.int16), format="s16", layout="stereo")
                frame.sample_rate, frame.pts = 48000, 960 * k
                container.mux(sound.encode(frame))
            container.mux(sound.encode(None))
    return path


@pytest.mark.parametrize("suffix", [".mp4", ".mkv"])
@pytest.mark.parametrize(("angle", "turns"), [(0, 0), (90, 1), (180, 2), (-90, 3)])
def test_turned_videos_are_upright_as_in_opencv(suffix: str, angle: int, turns: int, tmp_path: Path):
    path = write_with(tmp_path / f"turned{suffix}", RGB[:4], turned=angle)
    found = read_video(path)[0]
    info = probe_video(path)
    assert info.turns == turns
    assert (info.height, info.width) == found.shape[1:3] == ((64, 48) if turns % 2 else (48, 64))
    done, expected = cv2.VideoCapture(str(path)).read()
    assert done
    assert np.abs(found[0].astype(int) - expected[..., ::-1]).mean() < 3


def test_depth_beside_a_turned_video_is_refused(tmp_path: Path):
    folder, dataset, take = tmp_path / "recording", tmp_path / "set", make_take(frames=4, views=1, size=(64, 48))
    write_recording(take.views[0].clip, folder)
    export_lerobot([Episode.of_take(take)], dataset)
    (colours,) = dataset.glob("videos/observation.images.view_0/*/*.mp4")
    for path, where in ((folder / "rgb.mp4", folder), (colours, dataset)):
        write_with(path, RGB[:4], turned=180)
        with pytest.raises(RecordingError, match=rf"{path.name}.*their depth is not turned with them"):
            read_recording(where)
    (folder / "depth").rename(tmp_path / "depth")
    assert len(read_recording(folder)) == 4


def test_torn_videos_without_a_number_of_frames(tmp_path: Path):
    path = tmp_path / "torn.mkv"
    write_video(path, RGB, frames_per_s=30)
    assert probe_video(path).frames == 0
    assert len(list(play_video(path))) == FRAMES
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(RecordingError, match=r"ends after 0\.\d\d of 1\.00 s; the file is corrupt"):
        list(play_video(path))


def test_sound_that_goes_on_does_not_make_a_video_torn(tmp_path: Path):
    path = write_with(tmp_path / "loud.mkv", RGB, silence_s=3)
    assert len(list(play_video(path))) == FRAMES
    untold = tmp_path / "untold.mkv"  # when the pictures end is not said, and the file ends with its sound
    untold.write_bytes(path.read_bytes().replace(b"DURATION", b"SOMETHIN"))
    assert len(list(play_video(untold))) == FRAMES


def test_frames_of_uneven_length_are_whole(tmp_path: Path):
    path = tmp_path / "slides.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"bf": "0"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for picture, pts in zip(RGB, (0, 1, 2, 40, 41, 120), strict=False):
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts = pts
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    assert len(list(play_video(path))) == 6


def test_words_that_are_not_utf8(tmp_path: Path):
    path = tmp_path / "words.mp4"
    with av.open(str(path), "w") as container:
        container.metadata["title"] = "Kueche"
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        container.mux(stream.encode(av.VideoFrame.from_ndarray(RGB[0], format="rgb24")))
        container.mux(stream.encode(None))
    assert b"Kueche" in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(b"Kueche", b"K\xfcche "))
    assert len(list(play_video(path))) == 1


def test_two_writers_of_one_video(tmp_path: Path):
    """The last to finish counts, and neither takes the other's half-made file."""
    path, frame = tmp_path / "overlay.mp4", np.full((48, 64, 3), 90, np.uint8)

    def frames():
        yield from [frame] * 80  # more than the encoder keeps to itself before it opens the file
        assert write_video(path, [frame] * 3, frames_per_s=30) == 3
        yield frame

    assert write_video(path, frames(), frames_per_s=30) == 81
    assert len(read_video(path)[0]) == 81
    assert list(tmp_path.iterdir()) == [path]


def test_names_that_others_stumble_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    clip = make_take(frames=3, views=1, size=(64, 48)).views[0].clip
    write_recording(clip, tmp_path / "clip")
    (tmp_path / "clip" / "._rgb.mp4").write_bytes(b"Mac OS X")  # what other systems leave beside a video
    assert len(read_recording(tmp_path / "clip")) == 3
    monkeypatch.chdir(tmp_path / "clip")
    path = Path("drawer:3.mp4")
    write_video(path, RGB, frames_per_s=30)
    assert len(list(play_video(path))) == FRAMES
    assert path.exists()


def test_where_nothing_can_be_sought(tmp_path: Path):
    write_video(tmp_path / "bare.h264", RGB, frames_per_s=30)
    with pytest.raises(RecordingError, match="cannot be decoded at all"):
        list(play_video(tmp_path / "bare.h264", start_s=0.5))
