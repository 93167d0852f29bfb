"""The video of a load test, rendered or recorded: the units that a camera sends, and the reference boxes."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import chain, cycle, islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple, cast

import numpy as np

from catstream.base.addresses import is_live
from catstream.base.arrays import Float64
from catstream.base.box import Box
from catstream.base.names import UNNAMED, check_boxes
from catstream.client.saved_model import check_files
from catstream.errors import ObjectError, SettingsError, VideoError, errors_in
from catstream.measure.load_result import Plan, Report
from catstream.pipeline import Pipeline
from catstream.video import rendered
from catstream.video.frames import jpeg
from catstream.video.source import FileSource, open_source
from catstream.video.video_file import VideoFile
from catstream.video.writer import Encoder

_log = logging.getLogger(__name__)

_QUALITY = 90  # JPEG quality, typical of network cameras
_STILL_FRAMES = 24  # the first one is a keyframe
_MAX_BYTES = 1 << 30  # memory for a recording; a larger one is truncated and repeated
_SLICE = rb"\x00\x00\x01[\x01\x21\x41\x61\x25\x45\x65]"  # start of a NAL unit with a slice
_STEADY = 1.5  # maximum interval between two frames, relative to the median, of a constant frame rate


class Video(NamedTuple):
    """The video that is sent in a loop.

    units   JPEG files or access units of H.264; the first one is a keyframe
    still   units of the repeated first image, which are sent before
    boxes   boxes of objects in the first image, by name; the tracks of the first object are measured
    models  saved models of searched objects, by name
    truth   boxes of the first object, float64 (images, 4), NaN if it is absent: in each image and, for a recording, in
            its repetition, where tracking may differ
    """

    units: list[bytes]
    still: list[bytes]
    boxes: dict[str, Box]
    models: dict[str, Path]
    truth: Float64


def prepare(plan: Plan, frames: int, report: Report) -> Video:
    """Return the video of a plan, for a run of this number of frames.

    Raises VideoError if a recording cannot be read, and SettingsError if it does not contain the object.
    """
    return _recording(plan, frames, report) if plan.video else _rendering(plan, frames, report)


def _rendering(plan: Plan, frames: int, report: Report) -> Video:
    """Render the demo video, forwards, then backwards."""
    count, demo = min(frames, 2 * rendered.FRAMES - 2), rendered.Demo(plan.size)
    truth: dict[int, Box | None] = {}

    def images(numbers: Iterable[int]) -> Iterator[np.ndarray]:
        for number in numbers:
            report("rendering", number / count, f"{number} of {count} frames")
            image, truth[number] = demo.image(number)
            yield image

    still, units = [*_encoded(plan, images([0] * _STILL_FRAMES))], [*_encoded(plan, images(range(count)))]
    boxes = {"object-1" if plan.objects > 1 else UNNAMED: cast(Box, truth[0])}  # the flower is visible
    x, y = plan.size[0] / rendered.SIZE[0], plan.size[1] / rendered.SIZE[1]
    for n in range(plan.objects - 1):  # parts of the lake that remain in the picture
        boxes[f"object-{n + 2}"] = Box(x * (10 + 80 * (n % 4)), y * (110 + 85 * (n // 4)), 60 * x, 60 * y)
    return Video(units, still, boxes, {}, np.array([truth[number] or (np.nan,) * 4 for number in range(count)]))


def _encoded(plan: Plan, images: Iterable[np.ndarray]) -> Iterator[bytes]:
    if plan.source == "mjpeg":
        yield from (jpeg(image, quality=_QUALITY) for image in images)
        return
    encoder = Encoder(plan.size, rate=25)
    for image in images:
        yield from map(bytes, encoder.packets(image))
    yield from map(bytes, encoder.flush())


def with_recording(plan: Plan, rate: float | None) -> Plan:
    """Return the plan with the size, the number of objects and, by default, the rate of its recording.

    Raises VideoError if it has fewer than two frames or cannot be read, BoxError if a box is outside its first frame,
    ObjectError without an object, SettingsError for an unusable saved model.
    """
    if is_live(plan.video):
        raise VideoError(f"{plan.video} is a live source: record it to a file, and pass this file to --video")
    if not plan.boxes and not plan.models:
        raise ObjectError(f"no object to track in {plan.video}: pass --box X,Y,W,H of its first frame, or --model FILE")
    with open_source(plan.video, settings=plan.settings.run) as source:
        if len([*islice(source, 2)]) < 2:
            raise VideoError(f"{plan.video} has one frame: expected a video with two frames or more")
    check_boxes(plan.boxes, *source.size)
    with errors_in("--model", SettingsError):
        check_files(plan.models, plan.settings)
    width, height = (side + side % 2 if plan.source == "h264" else side for side in source.size)
    objects = len(plan.boxes) + len(plan.models)
    return replace(plan, size=(width, height), rate=rate or round(source.rate, 3), objects=objects)


def _recording(plan: Plan, frames: int, report: Report) -> Video:
    """Read a recording, or encode it, and track its first object in an unloaded run."""
    name, size = Path(plan.video).name, 0
    units: list[bytes] = []
    with open_source(plan.video, settings=plan.settings.run) as source:
        first, reader = next(source).image, source.reader if isinstance(source, FileSource) else None
        images = chain([first], (frame.image for frame in source))
        own = []
        if isinstance(reader, VideoFile):
            own = _access_units(plan, VideoFile(reader.path, plan.settings.run), frames)
        for unit in islice(own or _encoded(plan, images), frames):
            report(f"reading {name}", len(units) / frames, f"{len(units)} frames")
            units.append(unit)
            if (size := size + len(unit)) > _MAX_BYTES:
                break
    still = [*_encoded(plan, [first] * _STILL_FRAMES)]
    repeated = [*islice(cycle(units), min(frames, 2 * len(units)))]
    truth = np.array([*_unloaded_run(plan, [*still, *repeated], report)])[len(still) :]
    if len(truth) < len(repeated):
        raise VideoError(f"only {len(truth)} of {len(repeated)} frames of {plan.video} can be decoded: repair it first")
    if not np.isfinite(truth).any():
        raise SettingsError(f"an unloaded run has not found the object in {plan.video}: pass another box or model")
    return Video(units, still, plan.boxes, plan.models, truth)


def _access_units(plan: Plan, file: VideoFile, frames: int) -> list[bytes]:
    """Return the first access units of a recording in H.264 without B-frames and with one slice each, otherwise [].

    A receiver that decodes without delay loses the stream if the number of slices differs from the still image.
    """
    from av import Packet
    from av.bitstream import BitStreamFilterContext

    with file.container:
        packets = [packet for packet in islice(file.packets(), frames) if isinstance(packet, Packet)]
        times, codec = np.array([packet.pts or 0 for packet in packets]), file.stream.codec_context
        intervals = np.diff(np.sort(times))
        if len(intervals) and intervals.max() > _STEADY * np.median(intervals):
            _log.warning("%s has a variable frame rate: all frames are sent at %g frames/s", plan.video, plan.rate)
        is_ordered = not codec.has_b_frames and bool((intervals == np.diff(times)).all())
        is_whole = packets[0].is_keyframe and not any(packet.is_discard for packet in packets)
        is_h264 = plan.source == codec.name == "h264" and (codec.width, codec.height) == plan.size
        if not (is_h264 and is_ordered and is_whole):
            return []
        annex_b = BitStreamFilterContext("h264_mp4toannexb", file.stream)
        units = [bytes(unit) for packet in (*packets, None) for unit in annex_b.filter(packet)]
        return units if all(len(re.findall(_SLICE, unit)) == 1 for unit in units) else []


def _unloaded_run(plan: Plan, units: Iterable[bytes], report: Report) -> Iterator[tuple[float, ...]]:
    """Track in lockstep, and yield the boxes of the first object."""
    settings = plan.settings.replace({"run.lockstep": True, "run.endpoint": ""})
    with TemporaryDirectory(prefix="catstream-") as folder:
        (file := Path(folder, f"video.{plan.source}")).write_bytes(b"".join(units))
        with Pipeline(file, plan.boxes, settings, model=plan.models) as pipeline:
            for number, tracks in enumerate(pipeline.by_frame()):
                report("unloaded run", number / (pipeline.frames or 1), f"{number} frames")
                yield next(iter(tracks.values())).box or (np.nan,) * 4
