"""Reads frames from sources, and writes results files and annotated videos."""
