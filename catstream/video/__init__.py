"""Frames in, results out: sources, results files and annotated video."""
