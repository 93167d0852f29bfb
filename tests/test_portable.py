"""Commands and classes that start no pipeline run without the functions that only Linux has."""

import subprocess
import sys

import pytest

import catstream
from catstream.cli import load_command
from catstream.errors import ServiceError

#: Removes the functions that Windows or macOS lack, before anything is imported, and then runs the commands.
PROGRAM = """
import ctypes, os, select, signal, socket, sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name in ("fcntl", "grp", "pwd", "resource", "termios"):
            raise ModuleNotFoundError(name)

sys.meta_path.insert(0, Missing())
import multiprocessing.util  # imports from them at its first use
for name in ("fcntl", "grp", "pwd", "resource", "termios"):
    sys.modules.pop(name, None)
for module, names in {
    os: (
        *("O_CLOEXEC", "O_DIRECTORY", "O_NONBLOCK", "fork", "geteuid", "getuid", "memfd_create", "nice"),
        *("pidfd_open", "pread", "register_at_fork", "sched_getaffinity", "sysconf"),
    ),
    select: ("poll",),
    signal: ("SIGCHLD", "SIGHUP", "SIGSTOP", "pthread_sigmask"),
    socket: ("AF_UNIX", "recv_fds", "send_fds"),
}.items():
    for name in names:
        delattr(module, name)

import av, click, cv2, msgspec, numba, numpy, rich.progress, safetensors, scipy.linalg, sklearn.svm, threadpoolctl
sys.platform = "darwin"  # for catstream alone: these libraries are those of Linux
library, count = ctypes.CDLL, cv2.imcount
ctypes.CDLL = lambda name, *more, **named: None if name is None else library(name, *more, **named)  # no prctl
cv2.imcount = lambda name: count({}[name] if name.startswith("/proc/") else name)

from catstream.cli import main

def run(*words, code=0):
    sys.argv = ["catstream", *words]
    try:
        main()
    except SystemExit as end:
        assert (end.code or 0) == code, (words, end.code)

if __name__ == "__main__":
    what, video, first, last, walk = sys.argv[1:]
    if what == "annotate":
        with open("boxes.csv", "w") as table:
            table.write(f"file,object,x,y,w,h,frame\\n{video},anna,{first},0\\n")
        run("batch", "boxes.csv", "--output", "batch", "--jobs", "1")
        boxes = ["--box", f"anna@0={first}", "--box", f"anna@11={last}"]
        run("annotate", video, *boxes, "--output", "annotated", "--jobs", "1")
        run("export", "annotated/demo.ndjson", "demo.csv")
        run("report", "annotated")
    else:
        import catstream
        from catstream.video.source import open_source
        tracker = catstream.Tracker()
        with open_source(video) as source:
            tracker.init(next(source).image, first)
            for frame in source:
                tracker.update(frame.image)
        tracker.saved_model().save("anna.safetensors")
        run("find", "--model", "anna.safetensors", video, walk)
        run("find", "--model", "anna.safetensors", "rtsp://anna:secret@camera/", code=1)
        run("evaluate", walk, "--report", "report.html")
        catstream.CoresetTree(2)
    print("all ran")
"""


@pytest.mark.parametrize(("what", "folder"), [("annotate", "annotated"), ("find", ".")])
def test_commands_run_without_functions_of_linux(demo_video, walk, tmp_path, what, folder):
    video, boxes = demo_video(12)
    (tmp_path / "program.py").write_text(PROGRAM)
    command = [sys.executable, tmp_path / "program.py", what, video, str(boxes[0]), str(boxes[-1]), walk]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.stdout.endswith("all ran\n"), done.stderr
    assert (tmp_path / folder / "report.html").exists()


@pytest.mark.parametrize("system", ["win32", "darwin"])
def test_pipeline_on_another_system_is_an_error(monkeypatch, system):
    monkeypatch.setattr(sys, "platform", system)
    for start in (lambda: catstream.Pipeline, lambda: catstream.subscribe, lambda: load_command("track")):
        with pytest.raises(ServiceError, match="a pipeline requires Linux: use"):
            start()
    assert load_command("batch").name == "batch"
