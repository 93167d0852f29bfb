"""The processes of a pipeline: a loop each, the detector's pure core, the supervisor and the start server."""
