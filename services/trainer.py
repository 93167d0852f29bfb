"""Trains a model on each sample: see `python services/trainer.py --help`."""

from catstream.processes.by_hand import main

if __name__ == "__main__":
    main("trainer")
