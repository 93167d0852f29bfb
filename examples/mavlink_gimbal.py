"""Makes a running pipeline a MAVLink camera: a ground station selects the object, a gimbal learns where it is.

    pip install pymavlink
    catstream track rtsp://10.0.0.7/stream1 --set run.endpoint=run
    python examples/mavlink_gimbal.py run --link udpout:127.0.0.1:14550

The link is what pymavlink connects to: the UDP port of a ground station or of a router, or /dev/ttyACM0. The camera
sends a heartbeat, by which it is found, and answers REQUEST_MESSAGE with CAMERA_INFORMATION: it tracks rectangles.
CAMERA_TRACK_RECTANGLE sets the box, and CAMERA_STOP_TRACKING forgets the object. Meanwhile the camera sends
CAMERA_TRACKING_IMAGE_STATUS, ten times a second or as SET_MESSAGE_INTERVAL demands, with NaN as the rectangle while the
object is absent. Start the pipeline without a box, or with the box of one object.
"""

from __future__ import annotations

import argparse
import os
from contextlib import suppress
from math import inf, nan
from time import monotonic
from typing import Any

import catstream
from catstream.errors import BoxError, CommandRejectedError, SilenceError

os.environ["MAVLINK20"] = "1"  # before the import: messages of tracking exist in version 2 only
from pymavlink import mavutil
from pymavlink.dialects.v20 import common as mavlink

INTERVAL = 0.1  # seconds from one status to the next
NAME = [*b"catstream".ljust(32, b"\0")]

#: Fields of a status: whether it is active, its mode, and where the data are.
IDLE = (0, mavlink.CAMERA_TRACKING_MODE_NONE, 0)
ACTIVE = (1, mavlink.CAMERA_TRACKING_MODE_RECTANGLE, mavlink.CAMERA_TRACKING_TARGET_DATA_IN_STATUS)


class Camera:
    """Answers the commands of a ground station, and sends it the place of the object.

    link      connection of pymavlink
    pipeline  where commands are sent to
    size      width and height of the frames in pixels
    """

    def __init__(self, link: Any, pipeline: catstream.Control, size: tuple[int, int]) -> None:
        self.link, self.pipeline, self.size = link, pipeline, size
        self.interval = INTERVAL
        self.commanded = -1  # frame of the last command; tracks up to it may be of another object

    def beat(self) -> None:
        """Send the heartbeat of a camera."""
        self.link.mav.heartbeat_send(
            mavlink.MAV_TYPE_CAMERA, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE
        )

    def take(self, command: Any) -> None:
        """Execute a COMMAND_LONG for this camera, and acknowledge it."""
        mine = self.link.source_system, self.link.source_component
        if (command.target_system, command.target_component) != mine:
            return
        try:
            result = self._execute(command)
        except (BoxError, CommandRejectedError) as error:
            print(f"rejected: {error}", flush=True)
            result = mavlink.MAV_RESULT_DENIED
        except SilenceError as error:
            print(error, flush=True)
            result = mavlink.MAV_RESULT_FAILED
        sender = command.get_srcSystem(), command.get_srcComponent()
        self.link.mav.command_ack_send(command.command, result, 0, 0, *sender)

    def _execute(self, command: Any) -> int:
        width, height = self.size
        match command.command, command.param1:
            case mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE, left:
                right, top, bottom = command.param3, command.param2, command.param4
                box = left * width, top * height, (right - left) * width, (bottom - top) * height
                self._heed(self.pipeline.set_box(box))
            case mavlink.MAV_CMD_CAMERA_STOP_TRACKING, _:
                self._heed(self.pipeline.forget())
                self.report(None)
            # 521 is REQUEST_CAMERA_INFORMATION, of older ground stations.
            case (mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_CAMERA_INFORMATION) | (521, _):
                tracks = mavlink.CAMERA_CAP_FLAGS_HAS_TRACKING_RECTANGLE
                self.link.mav.camera_information_send(0, NAME, NAME, 0, nan, nan, nan, *self.size, 0, tracks, 0, b"")
            case mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAVLINK_MSG_ID_CAMERA_TRACKING_IMAGE_STATUS:
                microseconds = command.param2  # 0 for the default, -1 for none
                self.interval = inf if microseconds < 0 else microseconds / 1e6 or INTERVAL
            case _:
                return int(mavlink.MAV_RESULT_UNSUPPORTED)
        return int(mavlink.MAV_RESULT_ACCEPTED)

    def _heed(self, answer: Any) -> None:
        self.commanded = answer.frame
        print(answer.reason, flush=True)

    def report(self, track: catstream.Track | None) -> None:
        """Send where the object is, from 0 to 1 of the frame; None if nothing is tracked."""
        (width, height), status, corners = self.size, IDLE, [nan] * 4
        if track is not None:
            status = ACTIVE
            if track.box is not None:
                x, y, w, h = track.box
                corners = [x / width, y / height, (x + w) / width, (y + h) / height]
        self.link.mav.camera_tracking_image_status_send(*status, nan, nan, nan, *corners)


def newest(tracks: catstream.Subscription[catstream.Track]) -> catstream.Track | None:
    """Return the last track that has arrived since the last call, None if there is no new one."""
    track = None
    with suppress(SilenceError):
        for track in tracks:  # noqa: B007
            pass
    return track


def main() -> None:
    """Be a camera until the pipeline ends."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("endpoint", nargs="?", default="", help="endpoint of the pipeline; not needed if only one runs")
    parser.add_argument("--link", default="udpout:127.0.0.1:14550", help="connection of pymavlink [%(default)s]")
    parser.add_argument("--system", type=int, default=1, help="MAVLink system of the vehicle [%(default)s]")
    options = parser.parse_args()
    link = mavutil.mavlink_connection(
        options.link, source_system=options.system, source_component=mavlink.MAV_COMP_ID_CAMERA, dialect="common"
    )
    with catstream.subscribe(options.endpoint, "previews") as previews:
        picture = next(previews)
    with (
        catstream.control(options.endpoint) as pipeline,
        catstream.subscribe(options.endpoint, "tracks", timeout=0) as tracks,
    ):
        camera = Camera(link, pipeline, (picture.width, picture.height))
        track, beat, sent = None, 0.0, 0.0
        while tracks.end is None:
            if (command := link.recv_match(type="COMMAND_LONG", blocking=True, timeout=0.02)) is not None:
                camera.take(command)
            if monotonic() - beat >= 1:
                camera.beat()
                beat = monotonic()
            track = newest(tracks) or track
            if track is not None and track.frame > camera.commanded and monotonic() - sent >= camera.interval:
                camera.report(track)
                track, sent = None, monotonic()


if __name__ == "__main__":
    with suppress(KeyboardInterrupt):
        main()
