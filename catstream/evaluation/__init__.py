"""How well a tracker follows: annotated sequences in, measures and a report out."""
