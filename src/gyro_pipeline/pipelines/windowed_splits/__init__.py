"""Windowed splits: the windows that train, validate and test."""
