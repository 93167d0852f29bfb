"""Writes tracks to files and services, during a run or from its log; `destinations` has the table of formats."""
