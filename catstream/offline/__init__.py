"""Recorded videos, without processes: annotation of keyframes, tracked from both ends, and the search for an object."""
