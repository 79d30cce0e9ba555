"""Windowed splits: the windows that train, validate and test."""

from gyro_pipeline.pipelines.windowed_splits.pipeline import create_pipeline

__all__ = ["create_pipeline"]
