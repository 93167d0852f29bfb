"""The web page of a pipeline or of a fleet: live view, control and metrics."""
