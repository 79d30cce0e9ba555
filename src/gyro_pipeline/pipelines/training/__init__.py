"""Trainings: a tracked run per estimator, training set, window and seed."""
