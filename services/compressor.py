"""Owns the coreset trees: features in, samples out: `python services/compressor.py --help`."""

from catstream.processes.by_hand import main

if __name__ == "__main__":
    main("compressor")
