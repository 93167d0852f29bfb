"""Trains a model on each sample: `python services/trainer.py --help`."""

from catstream.processes.__main__ import start

if __name__ == "__main__":
    start("trainer")
