"""Ground truth: the bias of every recording, and the noise of every gyroscope."""

from gyro_pipeline.pipelines.ground_truth.pipeline import create_pipeline, create_report

__all__ = ["create_pipeline", "create_report"]
