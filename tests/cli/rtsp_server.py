"""A real RTSP server on loopback, GStreamer's: the JPEGs of a folder again and again, as H.264, 30 a second.

For a Python that has `gi`, usually the system's: `python3 rtsp_server.py FOLDER PORT` prints its port, and runs
until it is killed. Without GStreamer's server or a plugin of it, it says so and exits with 3.
"""

import sys


def main(folder, port):
    try:
        import gi

        gi.require_version("Gst", "1.0")
        gi.require_version("GstRtspServer", "1.0")
        from gi.repository import GLib, Gst, GstRtspServer
    except (ImportError, ValueError) as error:
        print(error, file=sys.stderr)
        sys.exit(3)
    Gst.init(None)
    steps = (
        f"multifilesrc location={folder}/%05d.jpg loop=true caps=image/jpeg,framerate=30/1",
        "identity sync=true",
        "jpegdec",
        "videoconvert",
        "x264enc tune=zerolatency speed-preset=ultrafast threads=1 key-int-max=30",
        "rtph264pay name=pay0 pt=96",
    )
    missing = [step.split()[0] for step in steps if not Gst.ElementFactory.find(step.split()[0])]
    if missing:
        print("GStreamer has no", ", ".join(missing), file=sys.stderr)
        sys.exit(3)
    factory = GstRtspServer.RTSPMediaFactory()
    factory.set_launch(f"( {' ! '.join(steps)} )")
    factory.set_shared(True)
    server = GstRtspServer.RTSPServer()
    server.set_address("127.0.0.1")
    server.set_service(port)
    server.get_mount_points().add_factory("/one", factory)
    server.attach(None)
    print(server.get_bound_port(), flush=True)
    GLib.MainLoop().run()


if __name__ == "__main__":
    main(*sys.argv[1:])
