"""The web page of a pipeline or of a fleet: live view, control and metrics."""

from catstream.errors import require_extra

require_extra("view")
