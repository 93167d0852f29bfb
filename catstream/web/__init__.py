"""The web page of a running pipeline: look at it, steer it, measure it."""

from catstream.extras import require_extra

require_extra("view")
