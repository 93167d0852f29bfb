"""Reads frames from files, cameras and streams; writes and draws on videos; renders the test videos."""
