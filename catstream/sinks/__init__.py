"""Sinks: where the tracks of a running pipeline go, a kind of file each."""
