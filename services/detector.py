"""Tracks the objects in each frame, and sends tracks and features: `python services/detector.py --help`."""

from catstream.processes.__main__ import start

if __name__ == "__main__":
    start("detector")
