"""Rapid gyroscope calibration, from raw logs to tracked trainings to tables and figures."""

import os

__version__ = "0.1.0"

# MLflow reads these when it is first imported. Runs send nothing over the network, and do not show
# MLflow's messages.
os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
os.environ.setdefault("MLFLOW_LOGGING_LEVEL", "WARNING")

# Arrow's allocator would reserve a gigabyte of addresses, which the limits of clusters count.
os.environ.setdefault("MIMALLOC_ARENA_RESERVE", "64MiB")
