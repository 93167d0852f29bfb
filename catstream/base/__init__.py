"""What every part uses: boxes, settings, errors, names, files, threads."""
