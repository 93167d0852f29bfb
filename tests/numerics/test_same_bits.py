"""The same bits in every process: whatever the program has imported, and on any number of cores."""

import os
import subprocess
import sys

import pytest

#: Prints a digest of two models that a Tracker learns, merged.
PROGRAM = """
import sys
from itertools import islice
from hashlib import blake2b

import catstream
from catstream.video.source import open_source

video, *boxes = sys.argv[1:]
models = []
with open_source(video) as source:
    for box in boxes:
        tracker = catstream.Tracker()
        for number, frame in enumerate(islice(source, 25)):
            tracker.update(frame.image) if number else tracker.init(frame.image, box)
        models.append(tracker.learned())
print(blake2b(catstream.merge(models).to_bytes()).hexdigest())
"""

ORDERS = {"catstream first": "", "catstream last": "import numpy, scipy.linalg, cv2, sklearn.linear_model\n"}


def test_what_is_learned_has_the_same_bits_in_any_order_of_imports_and_on_any_number_of_cores(demo_video):
    cores = sorted(os.sched_getaffinity(0))
    if len(cores) < 2:
        pytest.skip("this machine has one core")
    path, boxes = demo_video(50)
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    started = [
        subprocess.Popen(
            [sys.executable, "-c", imports + PROGRAM, path, *(",".join(map(str, boxes[i])) for i in (0, 25))],
            env=environment,
            stdout=subprocess.PIPE,
            text=True,
            preexec_fn=lambda some=some: os.sched_setaffinity(0, some),
        )
        for imports in ORDERS.values()
        for some in (cores[:1], cores[:2])
    ]
    lines = [process.communicate()[0] for process in started]
    assert [process.returncode for process in started] == [0] * 4
    assert len(set(lines)) == 1, lines
