"""Labelled recordings from raw logs."""

from gyro_pipeline.pipelines.raw_logs.pipeline import create_pipeline

__all__ = ["create_pipeline"]
