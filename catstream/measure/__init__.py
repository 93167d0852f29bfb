"""Accuracy on sequences with ground truth, and load tests, with their reports."""
