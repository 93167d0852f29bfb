"""The web page of a running pipeline: live view, control and metrics."""

from catstream.errors import require_extra

require_extra("view")
