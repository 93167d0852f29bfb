"""Frames that show their number, and videos of them."""

from __future__ import annotations

import tempfile
from fractions import Fraction
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

H264 = dict.fromkeys((".mp4", ".mkv", ".ts", ".mov", ".h264", ".flv", ".MTS", ".m3u8"), "libx264")
CODECS = {**H264, ".avi": "mjpeg", ".mpg": "mpeg2video", ".wmv": "wmv2"}


@lru_cache(200)
def numbered(number: int, width: int = 160, height: int = 120) -> np.ndarray:
    """Noise with a white field for each bit of the number that is 1, and a black one for the other bits below 128."""
    image = np.random.default_rng(number).integers(60, 190, (height, width, 3), np.uint8)
    for bit, field in enumerate(_fields(image)):
        if bit < 7 or number >> bit & 1:
            field[:] = 255 * (number >> bit & 1)
    return image


def number_of(image: np.ndarray) -> int:
    """The number that `numbered` wrote, also after lossy coding or scaling."""
    return sum(int(field.mean() > 180) << bit for bit, field in enumerate(_fields(image)))


def _fields(image: np.ndarray) -> list[np.ndarray]:
    """The fields of 14 bits, in two rows."""
    h, w = image.shape[0] // 6, image.shape[1] // 8
    corners = [(row * h + h // 5, column * w + w // 5) for row in range(2) for column in range(7)]
    return [image[y : y + h * 4 // 5, x : x + w * 4 // 5] for y, x in corners]


def write_video(
    path: Path,
    frames: int,
    options: tuple[tuple[str, str], ...] = (),
    *,
    size: tuple[int, int] = (160, 120),
    aspect: Fraction = Fraction(0),
    rotation: int = 0,
    times: tuple[float, ...] = (),
    sound: float = 0.0,
    title: str = "",
) -> None:
    """Write numbered frames.

    options  of the container, and with the prefix v: of the codec
    aspect   of a pixel
    times    time stamps of the frames in seconds; empty for 25 frames per second
    sound    seconds of a sound track
    """
    codec = CODECS[path.suffix]
    # The same bytes in each run: Matroska has random identifiers, x264's macroblock tree is chaotic.
    muxing = {"fflags": "bitexact", "cluster_time_limit": "400"}  # a long Matroska has many clusters
    coding = {"preset": "superfast"} if codec == "libx264" else {}
    for key, value in options:
        (coding if key.startswith("v:") else muxing)[key.removeprefix("v:")] = value
    with av.open(str(path), "w", options=muxing) as container:
        container.metadata["title"] = title
        stream: Any = container.add_stream(codec, rate=25, options=coding)
        stream.width, stream.height = size
        stream.codec_context.thread_count = 3  # the bytes depend on it
        stream.codec_context.sample_aspect_ratio = aspect
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        tone: Any = container.add_stream("aac", rate=16000, layout="mono") if sound else None
        if rotation:
            stream.set_display_rotation(rotation)
        for number in range(frames):
            frame = av.VideoFrame.from_ndarray(numbered(number, *size), format="bgr24")
            if times:
                frame.pts, frame.time_base = round(1000 * times[number]), Fraction(1, 1000)
                stream.codec_context.time_base = frame.time_base
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
        if sound:
            samples = av.AudioFrame.from_ndarray(np.zeros((1, round(16000 * sound)), np.float32), "fltp", "mono")
            samples.sample_rate = 16000
            container.mux([*tone.encode(samples), *tone.encode(None)])


@cache
def _encoded(suffix: str, frames: int, options: tuple[tuple[str, str], ...], **others: Any) -> bytes:
    if CODECS[suffix] not in av.codecs_available:
        pytest.skip(f"this FFmpeg cannot write {CODECS[suffix]}")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"a{suffix}")
        write_video(path, frames, options, **others)
        return path.read_bytes()


def make_video(path: Path, frames: int = 100, options: dict[str, str] | None = None, **others: Any) -> Path:
    """Write a video as `write_video` does, which is encoded once for many tests."""
    path.write_bytes(_encoded(path.suffix, frames, tuple((options or {}).items()), **others))
    return path


def damaged(path: Path, share: float) -> Path:
    """The video with a twentieth of its bytes overwritten, from a share of it on."""
    data = bytearray(path.read_bytes())
    start, count = int(share * len(data)), len(data) // 20
    data[start : start + count] = np.random.default_rng(0).integers(0, 256, count, np.uint8).tobytes()
    path.write_bytes(data)
    return path
