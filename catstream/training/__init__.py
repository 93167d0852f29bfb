"""Trains a model from a sample of the coreset trees, and estimates the motion of the object by EM."""
