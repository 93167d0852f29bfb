"""The foundations: boxes, settings, names, files, threads."""
