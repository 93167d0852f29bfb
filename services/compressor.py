"""Owns the coreset trees: features in, samples out: `python services/compressor.py --help`."""

from catstream.processes.__main__ import start

if __name__ == "__main__":
    start("compressor")
