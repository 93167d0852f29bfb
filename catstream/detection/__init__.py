"""Finds the object in a frame with the newest model."""
