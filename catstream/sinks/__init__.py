"""Sinks: where tracks go, during a run or from its log. The table of them is in `catstream.sinks.destinations`."""
