"""The parts of the paper that are not used by default, for comparison: its first tracker and its classifier."""
