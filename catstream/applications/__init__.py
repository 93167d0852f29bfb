"""Applications of the tracker: evaluation, finding, summaries and load tests, and the HTML of their reports."""
