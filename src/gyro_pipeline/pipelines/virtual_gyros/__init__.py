"""Virtual gyroscopes, Dataset-3 and Dataset-4: simulated recordings like the real ones."""

from gyro_pipeline.pipelines.virtual_gyros.pipeline import create_pipeline

__all__ = ["create_pipeline"]
