"""A stream of a fleet: runs a pipeline on this node, stores its state, and reports to the controller.

A `Stream` does not depend on Ray; `catstream.fleet.controller` makes it an actor. Its pipeline runs in a thread, and is
restarted after a failure. A second thread stores its state, so a slow store does not delay the tracks.
"""

from __future__ import annotations

import logging
import math
import shutil
import threading
import time
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path

from catstream.base.addresses import is_live, without_password
from catstream.client.address import Address
from catstream.client.attach import control
from catstream.client.saved_model import SavedModel
from catstream.errors import (
    CatstreamError,
    CommandRejectedError,
    FencedError,
    FleetError,
    ServiceError,
    StoreError,
)
from catstream.fleet.spec import StreamSpec
from catstream.fleet.store import Claim, Store
from catstream.output.destinations import Origin, TrackedFrame
from catstream.output.events import check_zones
from catstream.output.track_log import OpenFiles, RunFiles, is_log
from catstream.pipeline import Pipeline
from catstream.processes.state import DESIRED, files, restore
from catstream.wire.discovery import free_ports, private_folder
from catstream.wire.keys import Client, ensure, public_key, synchronise
from catstream.wire.messages import StreamState, StreamStatus, Track
from catstream.wire.storage import Metadata

FIRST_PAUSE_SECONDS = 1.0  # initial pause of the exponential backoff before a restart
LONGEST_PAUSE_SECONDS = 60.0  # maximum pause; after this time without a failure, the pause is reset
_TRACKS_SECONDS = 0.1  # timeout for a frame
_CHECK_SECONDS = 5.0  # interval between two checks of the claim if `every` is 0
_STORE_RATE = 0.1e6  # limit in bytes per second if `every` is 0: 9 GB a day

_log = logging.getLogger(__name__)


class Stream:
    """Runs the pipeline of one stream until it ends or is stopped, and stores its state periodically.

    node     id of its node
    address  IP address of its sockets for other machines; empty if all clients are on this machine
    clients  clients that may connect, by name, if there is an address
    every    interval in seconds between two states in the store; 0 for an interval that grows with their size
    """

    def __init__(
        self, spec: StreamSpec, node: str, address: str, clients: dict[str, Client], store: str, every: float
    ) -> None:
        self._spec, self._address, self._clients = spec, address, clients
        self._url, self._every, self._rate = store, every or _CHECK_SECONDS, math.inf if every else _STORE_RATE
        self._store: Store
        self._claim: Claim
        source = without_password(spec.source)
        self._status = StreamStatus(spec.name, "starting", node, source, live=is_live(spec.source))
        self._stop, self._lock = threading.Event(), threading.Lock()
        self._stored_at = 0.0  # Unix time at which the state in the store was current
        self._failure = self._store_trouble = self._pipeline_trouble = ""
        self._superseded = self._has_tracked = False
        self._files: set[tuple[Path, int]] = set()  # files of the last stored state, with their modification times
        self._next_write = 0.0  # time from which the next state is stored
        self._stack = ExitStack()
        self._folder = self._stack.enter_context(private_folder())
        self._keys = self._folder / "keys"
        self._thread = threading.Thread(target=self._run, name=f"stream {spec.name}", daemon=True)
        self._thread.start()

    def report(self, clients: dict[str, Client] | None = None) -> tuple[StreamStatus, bool]:
        """The state of the stream, and whether it ended because another process has claimed it.

        Sets the clients that may connect from now on.
        """
        with self._lock:
            if clients is not None and clients != self._clients:
                self._clients = clients
                if self._address and self._keys.exists():
                    synchronise(self._keys, clients)
            troubles = filter(None, (self._failure, self._store_trouble, self._pipeline_trouble))
            stored = time.time() - self._stored_at if self._stored_at else None
            return replace(self._status, stored_seconds=stored, trouble="; ".join(troubles)), self._superseded

    def stop(self) -> str:
        """End the pipeline, and store its last state; returns the error of storing it, or ""."""
        self._stop.set()
        self._thread.join()
        self._stack.close()
        return self._store_trouble

    def _run(self) -> None:
        """Run the pipeline until the stream ends, is stopped, or is superseded; restart it after each failure."""
        pause = FIRST_PAUSE_SECONDS
        while not self._stop.is_set():
            began = time.monotonic()
            try:
                self._run_once()
                return
            except StoreError as error:  # the claim failed, so the pipeline was not started
                self._store_trouble = str(error)
            except Exception as error:  # must be reported to the controller
                _log.warning("%s failed", self._spec.name, exc_info=not isinstance(error, CatstreamError))
                with self._lock:
                    is_known = isinstance(error, CatstreamError)
                    self._failure = str(error) if is_known else f"{type(error).__name__}: {error}"
                    self._pipeline_trouble = ""
                    self._status = replace(self._status, state="failed", endpoint="", present={})
                if self._has_tracked:  # the state has changed
                    self._next_write = 0.0
                    self._write()
            pause = FIRST_PAUSE_SECONDS if time.monotonic() - began > LONGEST_PAUSE_SECONDS else pause
            self._stop.wait(pause)
            pause = min(2 * pause, LONGEST_PAUSE_SECONDS)

    def _run_once(self) -> None:
        """Claim the stream, and run the pipeline from the state in the store, or from the start."""
        # Step 1: claim the stream, and return if it has ended.
        self._store = Store(self._url)
        claim = self._claim = self._store.stream(self._spec.name).claim()
        self._store_trouble = ""
        shutil.rmtree(self._folder / "state", ignore_errors=True)  # of a failed run
        self._has_tracked, self._files, ended = False, set(), False
        facts: Metadata = claim.state.facts if claim.state is not None else {}
        if claim.state is not None and facts["ended"]:
            if facts["digest"] == self._spec.digest:
                with self._lock:
                    self._stored_at = float(facts["time"])
                    self._status = replace(self._status, state="ended", frame=int(facts["frame"]))
                return
            claim.state, facts = None, {}  # the spec has changed, so the stream begins again
        # Step 2: start the pipeline.
        with ExitStack() as stack:
            source, state = self._spec.source, self._folder / "state"
            settings = self._spec.settings | self._sockets(stack)
            if claim.state is None:
                pipeline = Pipeline(source, self._spec.boxes or None, settings, state=state)
            else:
                restore(state, claim.state.files)
                pipeline = Pipeline(source, settings=settings, resume=state)
            outputs, resume = None, claim.state is not None
            files = self._destinations(pipeline, resume=resume)
            closed_last = stack.enter_context(ExitStack())  # closed after the processes
            stack.enter_context(pipeline)
            with self._lock:
                self._failure = ""
                self._stored_at = float(facts.get("time", 0.0))
                server = public_key(self._keys) if self._address else ""
                self._status = replace(
                    self._status, state="starting", endpoint=pipeline.endpoint, server=server, token=claim.token
                )
            self._change_objects(pipeline, facts)
            over = threading.Event()
            storing = threading.Thread(target=self._keep_storing, args=(over,), name="store")
            storing.daemon = True  # a store that hangs must not keep the process alive
            storing.start()
            stack.callback(storing.join)
            stack.callback(over.set)
            # Step 3: receive the tracks and write them.
            for tracks in pipeline.by_frame(_TRACKS_SECONDS):
                self._update_status(pipeline, tracks, outputs)
                if tracks and files.destinations:
                    if outputs is None:
                        outputs = files.continued(pipeline.endpoint, resume=resume)
                        closed_last.enter_context(outputs)
                        stack.callback(outputs.end)  # called before the processes and the store are closed
                    outputs.write(TrackedFrame([*tracks.values()]))
                    pipeline.report_unwritten(outputs.not_written, outputs.trouble)
                elif outputs is not None:
                    outputs.idle()
                if self._stop.is_set():
                    break
            else:
                ended = True
        self._write_last(ended=ended)

    def _write_last(self, *, ended: bool) -> None:
        """Store the last state, which ends the stream; this is retried until it succeeds."""
        while not self._superseded:
            self._write(is_last=True, ended=ended)
            if not self._store_trouble:
                with self._lock:
                    self._status = replace(self._status, state="ended" if ended else self._status.state, present={})
                return
            if not ended or self._stop.wait(self._every):
                return

    def _destinations(self, pipeline: Pipeline, *, resume: bool) -> RunFiles:
        """The destinations of the tracks. If a log exists on this node, the run continues its frame numbers."""
        options = self._spec.options
        check_zones(options.zone, pipeline.size)
        origin = Origin(pipeline.header, Address(keys=pipeline.settings.run.keys), options)
        files = RunFiles(origin, None, list(self._spec.write))
        if resume and any(path.exists() for path in map(Path, files.destinations) if is_log(path)):
            pipeline.first_frame, pipeline.first_time = files.position()
        return files

    def _sockets(self, stack: ExitStack) -> dict[str, object]:
        """The settings of the sockets: in a private folder, or on ports of this node with new keys."""
        if not self._address:
            return {"run.endpoint": "", "run.keys": ""}
        with self._lock:
            ensure(self._keys)
            synchronise(self._keys, self._clients)
        return {
            "run.endpoint": f"tcp://{self._address}:{free_ports(self._address, stack)}",
            "run.keys": str(self._keys),
        }

    def _change_objects(self, pipeline: Pipeline, facts: Metadata) -> None:
        """Begin the objects that were added to the spec since the state was stored, and forget removed ones."""
        boxes, models = self._spec.boxes, self._spec.models
        previous = set(facts["objects"]) if facts else set(boxes)
        begin, search = sorted(boxes.keys() - previous), sorted(models.keys() - previous)
        forget = sorted(previous - boxes.keys() - models.keys())
        with control(Address(pipeline.endpoint, keys=pipeline.settings.run.keys)) as controlled:
            for name in begin:
                controlled.set_box(boxes[name], name)
            for name in forget:
                with suppress(CommandRejectedError):  # already forgotten
                    controlled.forget(name)
            for name in search:
                model = self._store.model(self._spec.name, name).newest()
                if model is None:
                    raise FleetError(f"the store has no saved model of {name!r}: apply the file of the fleet again")
                controlled.search(
                    SavedModel.from_bytes(model.files["model"], f"the model of {name!r} in the store"), name
                )

    def _update_status(self, pipeline: Pipeline, tracks: dict[str, Track], outputs: OpenFiles | None) -> None:
        """Update the status with the tracks of a frame, which are empty if no frame has arrived for a while."""
        troubles = [f"{process}: {trouble}" for process, trouble in pipeline.trouble.items()]
        if pipeline.lost_seconds:
            troubles.append(f"its source has been lost for {pipeline.lost_seconds:.0f} s")
        with self._lock:
            status = self._status
            if tracks:
                self._has_tracked = True
                models = {name: track.model_version for name, track in tracks.items()}
                present = {name: track.box is not None for name, track in tracks.items()}
                status = replace(status, frame=next(iter(tracks.values())).frame, models=models, present=present)
            state: StreamState = pipeline.holding or ("running" if self._has_tracked else "starting")
            skipped = int(pipeline.health.get("detector", {}).get("skipped", 0))
            present = status.present if state == "running" else {}
            missed = outputs.missed if outputs is not None else 0
            self._status = replace(status, state=state, skipped=skipped, missed=missed, present=present)
            self._pipeline_trouble = "; ".join(troubles)

    def _keep_storing(self, over: threading.Event) -> None:
        """Store the state periodically until the pipeline is over, or another process has claimed the stream."""
        while not over.wait(self._every) and not self._superseded:
            self._write()

    def _write(self, *, is_last: bool = False, ended: bool = False) -> None:
        """Store the state after commands or once its interval has elapsed; always check the claim.

        Errors are reported as trouble; a newer claim ends the stream.
        """
        state, trouble, now = self._folder / "state", "", time.time()
        facts: Metadata = {
            "time": now,
            "frame": self._status.frame,
            "objects": sorted(self._spec.boxes.keys() | self._spec.models.keys()),
            "digest": self._spec.digest,
            "ended": ended,
        }
        try:
            versions = {(path, path.stat().st_mtime_ns) for path in state.rglob("*.*") if path.is_file()}
            was_commanded = any(path.name == DESIRED for path, _ in versions - self._files)
            is_urgent = is_last or was_commanded or time.monotonic() >= self._next_write
            if versions == self._files and not is_last:
                self._claim.check()
                self._stored_at = now
            elif is_urgent and (content := files(state)):
                self._claim.write(content, facts)
                self._files, self._stored_at = versions, now
                self._next_write = time.monotonic() + sum(map(len, content.values())) / self._rate
            else:  # too early, or no checkpoint yet
                self._claim.check()
        except FencedError as error:
            _log.warning("%s: %s", self._spec.name, error)
            self._superseded = True
            self._stop.set()
        except FileNotFoundError:
            pass  # a newer checkpoint has just replaced it: the next iteration stores it
        except (ServiceError, OSError) as error:
            trouble = f"its state cannot be stored: {error}"
        with self._lock:
            self._store_trouble = trouble
