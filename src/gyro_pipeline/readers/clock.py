"""Sample rate and gaps, from timestamps and packet counters."""

from gyro_pipeline.readers.timing import Timing, check_rate, from_counter, from_stamps

__all__ = ["Timing", "check_rate", "from_counter", "from_stamps"]
