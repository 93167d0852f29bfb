"""Load tests: real pipelines on a broadcast whose every frame is known, at a rate that does not wait for them."""

from catstream.extras import require_extra

require_extra("loadtest")
