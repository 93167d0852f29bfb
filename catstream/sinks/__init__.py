"""Sinks: the file formats to which tracks are written."""
