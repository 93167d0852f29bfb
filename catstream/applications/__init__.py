"""Applications of the tracker: evaluation, finding and load tests, and the HTML of their reports."""
