"""The state of a pipeline on disk, from which it continues after a power cut.

    DIR/job.safetensors     the job of the run, a private file: see `catstream.processes.job`
    DIR/desired_state.json  the state that commands have set: see `catstream.processes.decisions`
    DIR/searched_models/    the saved models of searched objects: see `catstream.processes.model_files`
    DIR/trees/              the compressor's checkpoints: see `catstream.coreset.checkpoint_store`

A pipeline locks DIR, and its compressor DIR/trees. The kernel releases a lock when its process ends, even by a crash.
"""

from __future__ import annotations

import contextlib
import logging
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from shlex import quote

from catstream.base.files import locked_folder, write_atomically, writing
from catstream.base.forks import forked, generation
from catstream.base.names import UNNAMED
from catstream.base.settings import Settings
from catstream.base.text import listed
from catstream.client.saved_model import SavedModel
from catstream.coreset.checkpoint_store import CheckpointStore
from catstream.coreset.compressor import Compressor
from catstream.errors import CatstreamError, ObjectError, ServiceError
from catstream.processes.job import JOB, Job

#: Folder of the checkpoints, in the folder of the state.
CHECKPOINTS = "trees"
#: Folder of the saved models of searched objects, in the folder of the state.
SEARCHED = "searched_models"

#: Name of the file of the desired state, in the folder of the state.
DESIRED = "desired_state.json"

_SMALL = (JOB, DESIRED)
_LARGE = re.compile(rf"({CHECKPOINTS}/[0-9]+|{SEARCHED}/[0-9a-f]+)\.safetensors")
_ATTEMPTS = 5  # to read a checkpoint that may be replaced concurrently

_log = logging.getLogger(__name__)


def contains_run(folder: Path) -> bool:
    """Return True if a folder contains a run, complete or not, that can be resumed."""
    return (folder / JOB).exists()


def files_of_state(folder: Path) -> dict[str, Path]:
    """The state folder and its files, which no other output may overwrite, by their purpose."""
    return {"the state folder": folder} | {f"{name} of the state": folder / name for name in (*_SMALL, CHECKPOINTS)}


def position(folder: Path) -> tuple[int, float]:
    """Number and time of the last message in the newest valid checkpoint, after which the run is resumed."""
    return CheckpointStore(folder / CHECKPOINTS).position()


def learned(folder: Path, settings: Settings, name: str = UNNAMED) -> SavedModel:
    """The saved model of an object from the newest valid checkpoint; "" also means the only object.

    ObjectError if there is no such object; ServiceError if the checkpoint contains no model of it.
    """
    forest = CheckpointStore(folder / CHECKPOINTS).load(settings)
    if name == UNNAMED and len(forest.compressors) == 1:
        (name,) = forest.compressors
    if forest.compressors and name not in forest.compressors:
        wanted = repr(name) if name else "without a name"
        raise ObjectError(f"there is no object {wanted}: the objects are {listed(forest.compressors)}")
    return SavedModel.of(forest.compressors.get(name) or Compressor(settings, name), settings)


def files(folder: Path) -> dict[str, bytes]:
    """The content of the files from which a pipeline can continue at its newest checkpoint, by name.

    Empty without a checkpoint. The pipeline may be running.
    """
    for _ in range(_ATTEMPTS):
        with contextlib.suppress(FileNotFoundError):  # a newer file has just replaced it
            # The desired state is read before the saved models to which it refers: they are stored before it.
            content = {name: (folder / name).read_bytes() for name in _SMALL if (folder / name).exists()}
            checkpoints = sorted((folder / CHECKPOINTS).glob("[0-9]*.safetensors"))
            for path in [*(folder / SEARCHED).glob("[0-9a-f]*.safetensors"), *checkpoints[-1:]]:
                content[f"{path.parent.name}/{path.name}"] = path.read_bytes()
            return content if checkpoints else {}
    raise ServiceError(f"cannot read the state in {str(folder)!r} (it keeps changing): try again")


def restore(folder: Path, content: Mapping[str, bytes]) -> None:
    """Write the result of `files` to a new folder, from which a pipeline can be resumed.

    ServiceError if a name is unknown or a file cannot be written.
    """
    for name, data in content.items():
        if name not in _SMALL and not _LARGE.fullmatch(name):
            raise ServiceError(f"{name!r} is not a file of the state of a pipeline")
        with writing(folder):
            (folder / name).parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            write_atomically(folder / name, data, mode=0o600)


@contextlib.contextmanager
def locked(folder: Path, seconds: float = 0.0) -> Iterator[Path]:
    """Lock a state folder; ServiceError if it is still locked after `seconds`."""
    busy = f"a running pipeline uses the state in {str(folder)!r}: stop it, or use another folder"
    with locked_folder(folder, seconds=seconds, mode=0o700, busy=busy):
        yield folder


def check_new(folder: Path) -> None:
    """Raise ServiceError if a folder contains a run or parts of one."""
    if contains_run(folder):
        hint = f"already contains a run: continue it (--resume {quote(str(folder))}), or use another folder"
    elif (folder / CHECKPOINTS).exists():
        hint = f"contains a run without its {JOB}, which cannot be continued: use another folder"
    else:
        return
    raise ServiceError(f"{str(folder)!r} {hint}")


@contextlib.contextmanager
def locked_for_run(folder: Path, resumed: Job | None, job: Job) -> Iterator[None]:
    """Lock the state folder, and store the job in it if it is new or has changed."""
    with locked(folder):
        if resumed is None:
            check_new(folder)
        if job != resumed:
            job.save(folder)
        yield


@contextlib.contextmanager
def saved(
    files: Mapping[str, Path], state: Path, settings: Settings, report: Callable[[Path], object]
) -> Iterator[None]:
    """Save the model of each object to its file afterwards, and call `report` with each saved file.

    An error of the run takes precedence over errors of saving.
    """
    errors: list[CatstreamError] = []
    since = generation()
    try:
        yield
    finally:
        for name, file in files.items() if not forked(since) else ():
            try:
                learned(state, settings, name).save(file)
                report(file)
            except CatstreamError as error:
                errors.append(error)
        for problem in errors[0 if sys.exception() else 1 :]:
            _log.warning("%s", problem)
    if errors:
        raise errors[0]
