"""Finds the objects in a frame with their newest models, and chooses the training rows."""
