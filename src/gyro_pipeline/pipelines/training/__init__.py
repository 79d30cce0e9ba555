"""Trainings: a tracked run per estimator, training set, window and seed."""

from gyro_pipeline.pipelines.training.pipeline import create_pipeline

__all__ = ["create_pipeline"]
