"""Calibrate a gyroscope at rest: its bias, a standard deviation, and the seconds still needed.

    from gyro_pipeline.calibrator import Calibrator

    calibrator = Calibrator.open("B17", rate_hz=200, target_mdps=0.5)
    for time_s, gyro_dps in samples:
        state = calibrator.update(time_s, gyro_dps)
        if state.done:
            break

Importing this package imports only NumPy. ``docs/calibrator.md`` is the tutorial; the command line
is ``gyro-calibrate``.
"""

from gyro_pipeline.calibrator.calibrator import Calibrator, State
from gyro_pipeline.calibrator.device_types import DeviceType, read_type, type_of_models
from gyro_pipeline.calibrator.history import Calibration, Circumstances
from gyro_pipeline.calibrator.reasons import Reason

__all__ = [
    "Calibration",
    "Calibrator",
    "Circumstances",
    "DeviceType",
    "Reason",
    "State",
    "read_type",
    "type_of_models",
]
