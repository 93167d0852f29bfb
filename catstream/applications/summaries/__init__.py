"""Summaries: the images that keep most of the energy of a collection, and the frames that taught a tracker most."""
