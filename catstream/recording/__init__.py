"""Recordings: what a pipeline said, in one file; played to subscribers again, or learned from once more."""
