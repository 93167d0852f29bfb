"""Inserts features into the coreset trees, and publishes samples: see `python services/compressor.py --help`."""

from catstream.processes.by_hand import main

if __name__ == "__main__":
    main("compressor")
