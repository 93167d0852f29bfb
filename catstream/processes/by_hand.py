"""The command line of one process of a pipeline, for `services/detector.py`, `compressor.py` and `trainer.py`.

They may be started manually in any order, for example in three containers. `catstream track` starts and supervises all.
"""

from __future__ import annotations

from catstream.base.threads import limit_process

limit_process()  # before anything imports numpy

import sys
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from pathlib import Path

from catstream.base.names import boxes_by_name, split_name
from catstream.base.settings import Settings
from catstream.errors import CatstreamError, ObjectError
from catstream.processes.job import Job, files_by_name
from catstream.processes.process import run

_ABOUT = {
    "detector": "Track the objects in the frames of SOURCE; send tracks and features.",
    "compressor": "Compress the features in coreset trees; send samples.",
    "trainer": "Train a model on each sample; send models.",
}
_EXAMPLE = """
The three processes connect at an endpoint: a folder for their sockets, or tcp://127.0.0.1:PORT. All need the same
settings; an environment variable such as CATSTREAM_RUN_ENDPOINT also sets one.

  mkdir -m 700 run
  python services/compressor.py --set run.endpoint=run --state checkpoints &
  python services/trainer.py    --set run.endpoint=run &
  python services/detector.py   --set run.endpoint=run walk.mp4 --box 120,80,64,48
"""


def main(name: str) -> None:
    """Run a process with the arguments of the command line, and exit with its code; an error is one line."""
    options = vars(parser(name).parse_args())
    try:
        settings = Settings.load(overrides=options.pop("pairs"))
        boxes, models = (_by_name(option, options.pop(option, [])) for option in ("box", "model"))
        job = Job(**options, settings=settings, boxes=boxes_by_name(boxes), models=files_by_name(models))
        sys.exit(run(name, job))
    except CatstreamError as error:
        sys.exit(f"catstream: {error}")


def parser(name: str) -> ArgumentParser:
    """The arguments of a process."""
    arguments = ArgumentParser(
        prog=f"services/{name}.py",
        description=_ABOUT[name],
        epilog=_EXAMPLE,
        formatter_class=RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    setting = "One setting; may be repeated."
    arguments.add_argument("--set", dest="pairs", action="append", default=[], metavar="GROUP.NAME=VALUE", help=setting)
    if name != "trainer":
        arguments.add_argument("--state", type=Path, help="Folder for the checkpoints or the desired state.")
    if name == "detector":
        arguments.add_argument("source", metavar="SOURCE", help="A video, a folder of images, a camera or a stream.")
        box = "An object in the first frame, in pixels; may be repeated with names. Empty: none."
        arguments.add_argument("--box", action="append", default=[], metavar="[NAME=]X,Y,W,H", help=box)
        model = "Search for the object of a saved model; may be repeated with names. Empty: none."
        arguments.add_argument("--model", action="append", default=[], metavar="[NAME=]FILE", help=model)
        resume = "Continue after the last message of an earlier detector."
        arguments.add_argument("--resume", action="store_true", help=resume)
    return arguments


def _by_name(option: str, texts: list[str]) -> dict[str, str]:
    """The non-empty values of an option by object name; ObjectError if a name is not unique."""
    texts = [text for text in texts if text]
    values = dict(split_name(text) for text in texts)
    if len(values) < len(texts):
        options = " ".join(f"--{option} {text}" for text in texts)
        raise ObjectError(f"duplicate object ({options}): give each object its own name")
    return values
