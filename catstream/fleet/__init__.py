"""A fleet: many streams on many machines, placed by Ray, found by name, with their state in a store."""
