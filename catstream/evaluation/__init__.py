"""Measures the accuracy of trackers on annotated sequences, and writes reports."""
