"""Test errors, figures of merit and the ceiling, added to each run."""
