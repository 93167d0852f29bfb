"""A run: its job, the folder of its state, and the saved models of what it has learned."""
