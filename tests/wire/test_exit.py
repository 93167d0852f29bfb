"""A process may end while messages of closed sockets are still queued."""

import subprocess
import sys
import time

import zmq

from catstream.wire.channels import FEATURES
from catstream.wire.endpoint import Endpoint

SENDER = """
import sys
import numpy as np
from catstream.messages.kinds import Features, ObjectFeatures, Position, TrainingRows
from catstream.wire.acknowledged import Sender
from catstream.wire.channels import FEATURES
from catstream.wire.endpoint import Endpoint

rows = TrainingRows.labelled(np.ones((10, 100_000), np.float32), 1)
with Sender(FEATURES, Endpoint.parse(sys.argv[1]), 64) as features:
    features.ask_position(0)
    features.window.resume(0, Position())
    for seq in range(1, 33):
        features.send(Features(seq, seq - 1, 0.0, {"anna": ObjectFeatures(None, {"appearance": rows})}))
"""


def test_a_process_that_ends_with_queued_messages_ends_normally(folder):
    place = Endpoint.parse(str(folder))
    with zmq.Context.instance().socket(zmq.ROUTER) as receiver:
        receiver.set(zmq.LINGER, 0)
        receiver.set(zmq.RCVHWM, 1)
        receiver.bind(place.listening(FEATURES))
        with subprocess.Popen([sys.executable, "-c", SENDER, str(folder)], stderr=subprocess.PIPE) as sender:
            while sender.poll() is None:
                time.sleep(0.02)
                if receiver.poll(0):
                    receiver.recv_multipart()
            assert sender.returncode == 0, sender.stderr.read().decode()
