"""Tracks the objects in each frame, and sends tracks and features: see `python services/detector.py --help`."""

from catstream.processes.by_hand import main

if __name__ == "__main__":
    main("detector")
