"""Attaches to a running pipeline: subscription and control, and the registry that finds a stream of a fleet."""
