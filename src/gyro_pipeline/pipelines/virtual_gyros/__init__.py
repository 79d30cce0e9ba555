"""Dataset-3 and Dataset-4: recordings of gyroscopes that do not exist."""

from gyro_pipeline.pipelines.virtual_gyros.pipeline import create_pipeline

__all__ = ["create_pipeline"]
