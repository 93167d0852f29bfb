"""Finds the objects of saved models in videos, folders and images."""
