"""The report: the paper's tables and figures, from tracked runs and recordings alone."""

from gyro_pipeline.pipelines.reporting.pipeline import create_pipeline

__all__ = ["create_pipeline"]
