"""The processes of a pipeline: a loop each, its decisions as pure functions, the supervisor and the start server."""
