"""Test errors, figures of merit and the ceiling, added to each run."""

from gyro_pipeline.pipelines.evaluation.pipeline import create_pipeline

__all__ = ["create_pipeline"]
