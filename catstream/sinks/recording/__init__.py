"""Recordings: the messages of a run in MCAP files, to be played to subscribers or to be trained from again."""
