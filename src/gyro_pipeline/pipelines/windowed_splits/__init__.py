"""Which recordings train, validate and test."""

from gyro_pipeline.pipelines.windowed_splits.pipeline import create_cut_pipeline, create_pipeline

__all__ = ["create_cut_pipeline", "create_pipeline"]
