"""One tracked run per network."""

from gyro_pipeline.pipelines.training.pipeline import create_leakage_pipeline, create_pipeline

__all__ = ["create_leakage_pipeline", "create_pipeline"]
