"""The parts that only the paper has, for comparison: its first tracker and its classifier."""
