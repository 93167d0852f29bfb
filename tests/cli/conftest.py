"""Fixtures of the command line; they have the scope "session" because their runs take seconds."""

import pytest


@pytest.fixture(scope="session")
def video(demo_video):
    """A short demo video of 32 frames, and the box in its first frame as `--box` takes it."""
    path, boxes = demo_video(32)
    return str(path), ",".join(map(str, boxes[0]))


@pytest.fixture(scope="session")
def long_video(demo_video):
    """The same of 60 frames, for events that take longer."""
    path, boxes = demo_video(60)
    return str(path), ",".join(map(str, boxes[0]))


@pytest.fixture(scope="session")
def whole_run(video, once, succeed):
    """The folder of a run in lockstep without faults.

    out     its results, with a video
    model   its saved model
    stdout  its tracks, as `--write -` prints them
    stderr  its messages
    """

    def run(folder):
        source, box = video
        files = ["--output", "out", "--video", "--save-model", "model", "--write", "-"]
        output, errors = succeed("track", source, "--box", box, *files, "--lockstep", cwd=folder)
        (folder / "stdout").write_text(output)
        (folder / "stderr").write_text(errors)

    return once("whole-run", run)
