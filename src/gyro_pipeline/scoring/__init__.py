"""Scores of estimates: truths, errors, figures of merit and their intervals."""
