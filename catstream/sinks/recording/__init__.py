"""Recordings: the messages of a run in one file, to be played to subscribers or to be trained from again."""
