"""The paper's tables and figures, from tracked runs alone."""

from gyro_pipeline.pipelines.reporting.pipeline import create_leakage_pipeline, create_pipeline

__all__ = ["create_leakage_pipeline", "create_pipeline"]
