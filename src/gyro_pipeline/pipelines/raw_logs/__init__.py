"""Labelled recordings from raw logs."""
