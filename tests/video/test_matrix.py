"""Containers, codecs, frame rates, sound and joins: all frames and their times equal those of Debian's FFmpeg."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from catstream.video.source import open_source
from catstream.video.video_frames import VideoFrames
from tests.video.pictures import number_of, numbered

pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="no ffmpeg to compare with: apt-get install ffmpeg"),
]

FRAMES, RATE = 24, 25
_B_FRAMES = "-bf 2 -g 8"
#: Options of the encoder of each codec.
CODECS = {
    "H.264": f"-c:v libx264 -preset superfast -pix_fmt yuv420p {_B_FRAMES}",
    "HEVC": "-c:v libx265 -preset superfast -x265-params log-level=error:keyint=8",
    "AV1": "-c:v libaom-av1 -cpu-used 8 -g 8 -crf 40",
    "VP8": "-c:v libvpx -deadline realtime -g 8 -crf 20 -b:v 1M",
    "VP9": "-c:v libvpx-vp9 -deadline realtime -cpu-used 8 -lag-in-frames 16 -auto-alt-ref 1 -g 8",
    "MPEG-4": f"-c:v mpeg4 -qscale:v 3 {_B_FRAMES}",
    "MPEG-2": f"-c:v mpeg2video -qscale:v 3 {_B_FRAMES}",
    "MPEG-1": f"-c:v mpeg1video -qscale:v 3 {_B_FRAMES}",
    "MJPEG": "-c:v mjpeg -qscale:v 3 -pix_fmt yuvj420p",
    "ProRes": "-c:v prores_ks",
    "FFV1": "-c:v ffv1",
    "Theora": "-c:v libtheora -qscale:v 9 -g 8",
    "WMV": "-c:v wmv2 -qscale:v 3",
    "Sorenson": "-c:v flv -qscale:v 3",
    "GIF": "-c:v gif",
    "raw": "-pix_fmt yuv420p",
}
#: Codecs of each container, and that of its sound.
CONTAINERS = {
    "mp4": ("H.264 HEVC AV1 VP9 MPEG-4", "aac"),
    "mov": ("H.264 ProRes MJPEG", "pcm_s16le"),
    "3gp": ("H.264", "aac"),
    "mkv": ("H.264 VP9 FFV1 Theora", "aac"),
    "webm": ("VP8 VP9 AV1", "libopus"),
    "avi": ("H.264 MPEG-4 MJPEG FFV1", "pcm_s16le"),
    "ts": ("H.264 HEVC MPEG-2", "aac"),
    "m2ts": ("H.264", "ac3"),
    "mpg": ("MPEG-1 MPEG-2", "mp2"),
    "vob": ("MPEG-2", "ac3"),
    "flv": ("H.264 Sorenson", "aac"),
    "wmv": ("WMV", "wmav2"),
    "ogv": ("Theora", "libvorbis"),
    "mxf": ("MPEG-2", ""),
    "nut": ("FFV1", "aac"),
    "gif": ("GIF", ""),
    "y4m": ("raw", ""),
    "h264": ("H.264", ""),
    "hevc": ("HEVC", ""),
}
#: Containers without time stamps: frames have equal distances.
RAW = {"y4m", "h264", "hevc"}
FORMATS = [(container, codec) for container, (codecs, _) in CONTAINERS.items() for codec in codecs.split()]

#: Frame n of an irregular video is shown at so many twenty-fifths of a second.
IRREGULAR = "(N+floor(N/3)+2*floor(N/7))"


@pytest.fixture(scope="session")
def pictures(tmp_path_factory):
    """Uncompressed frames that show their number."""
    path = tmp_path_factory.mktemp("pictures") / "numbered.bgr"
    path.write_bytes(b"".join(numbered(number).tobytes() for number in range(FRAMES)))
    return path


def ffmpeg(*words: object) -> None:
    subprocess.run(["ffmpeg", "-nostdin", "-v", "error", "-y", *map(str, words)], check=True)


def make(path: Path, pictures: Path, codec: str, *, times: str, sound: bool = False) -> Path:
    """Write the pictures at these times, with a sound that outlasts them."""
    container = path.suffix[1:]
    tone: list[object] = []
    coder: list[object] = []
    if sound and CONTAINERS[container][1]:
        tone = ["-f", "lavfi", "-itsoffset", 0.2, "-i", "sine=duration=2.5:sample_rate=48000"]
        coder = ["-ac", 2, "-c:a", CONTAINERS[container][1]]
    stamps = f"settb=1/1000,setpts=({times}/{RATE})/TB" if container not in RAW else "null"
    ffmpeg(
        *("-f", "rawvideo", "-pix_fmt", "bgr24", "-s", "160x120", "-framerate", RATE, "-i", pictures, *tone),
        *("-vf", stamps, "-fps_mode", "passthrough", *CODECS[codec].split(), *coder, path),
    )  # fmt: skip
    return path


def reference_times(path: Path) -> list[float | None]:
    """The times of the frames according to ffprobe, None where it has none."""
    command = ["ffprobe", "-v", "quiet", "-select_streams", "V:0", "-show_entries", "frame=best_effort_timestamp_time"]
    answer = json.loads(subprocess.run([*command, "-of", "json", path], check=True, capture_output=True).stdout)
    times = [frame.get("best_effort_timestamp_time") for frame in answer["frames"]]
    return [None if time is None else float(time) for time in times]


def read(path: Path) -> tuple[list[int], list[float]]:
    with open_source(path) as source:
        frames = list(source)
        # A cut may begin with frames that cannot be decoded, because they refer to some before it.
        assert len(frames) <= (source.frames or 0) <= len(frames) + (3 if path.stem == "cut" else 0)
    return [number_of(frame.image) for frame in frames], [frame.time for frame in frames]


def assert_close(times: list[float], wanted: list[float | None]) -> None:
    """Compare times from the first frame that has one on."""
    assert len(times) == len(wanted)
    known = [(time, other) for time, other in zip(times, wanted, strict=True) if other is not None]
    assert [time - known[0][0] for time, _ in known] == pytest.approx([o - known[0][1] for _, o in known], abs=0.0015)


@pytest.mark.parametrize(("container", "codec"), FORMATS, ids=str)
def test_frames_and_times_equal_those_of_ffmpeg(tmp_path, pictures, container, codec):
    constant = make(tmp_path / f"constant.{container}", pictures, codec, times="N")
    variants = [(constant, range(FRAMES))]
    if container not in RAW:
        variable = tmp_path / f"variable.{container}"
        variants.append((make(variable, pictures, codec, times=IRREGULAR, sound=True), range(FRAMES)))
        cut = tmp_path / f"cut.{container}"
        # Debian's FFmpeg has wrong times of these two, and frames before the cut.
        if container != "ogv" and codec != "AV1":
            ffmpeg("-ss", 0.48, "-i", constant, "-c", "copy", cut)
            variants.append((cut, None))
    for path, wanted in variants:
        numbers, times = read(path)
        assert_close(times, [n / RATE for n in range(FRAMES)] if container in RAW else reference_times(path))
        assert numbers == list(wanted or range(numbers[0], numbers[0] + len(times))), path.name
        frames = VideoFrames(path)
        frames.scan()
        assert list(frames.times) == times
        assert [number_of(frames[number]) for number in reversed(range(len(frames)))] == numbers[::-1]


def test_how_to_lists_the_compared_formats():
    page = Path(__file__).parents[2] / "docs" / "how-to" / "sources.md"
    rows = dict(re.findall(r"^\.(\w+) +(.+)$", page.read_text(), re.MULTILINE))
    assert rows == {container: codecs.replace(" ", ", ") for container, (codecs, _) in CONTAINERS.items()}
