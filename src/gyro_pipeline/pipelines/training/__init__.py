"""One tracked run per network."""

from gyro_pipeline.pipelines.training.pipeline import create_pipeline

__all__ = ["create_pipeline"]
