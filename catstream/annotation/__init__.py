"""Annotation of a video: boxes of objects at keyframes, and tracks between them in both directions."""
