"""The HTML of reports, and the provenance of their figures."""
