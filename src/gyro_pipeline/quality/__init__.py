"""Quality control of a recording: was it at rest, and which of its rows hold a measurement?

A recording passes through checks until one rejects it. Brief disturbances are masked and do not end
the recording; a gap in time does. Limits account for the number of samples that are compared.
Motion rejects the whole recording: rates alone do not show which part was at rest, and after a turn
the Earth's rate is distributed differently among the axes.

The checks cannot detect a rotation as steady as a bias, steps of 0.1 deg/s up and down every few
seconds, sways of 0.05 deg/s, and sways of any size with a period of one or two blocks. They miss
several devices in random order less than about 8 sigma apart, or in turn less than about 4 sigma
apart if rows are lost, and may miss more than 16 devices in turn. They take a steady vibration at a
half, a third or a quarter of the sample rate for several devices.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from gyro_pipeline.conventions import AXES, InputError
from gyro_pipeline.logs import KEPT, REJECTED, REPAIRED, Finding, Log
from gyro_pipeline.quality.rest import Mask

if TYPE_CHECKING:
    from gyro_pipeline.parameters import Quality
    from gyro_pipeline.quality.recording import Recording


@dataclass(frozen=True)
class Inspected:
    """The result of quality control for a recording.

    Attributes:
        outcome: KEPT, REPAIRED or REJECTED, the worst outcome of the findings.
        start: First sample of the log to keep, from 0.
        stop: End of the samples to keep, exclusive; equal to ``start`` if none is kept.
        masked: (stop - start,), whether each row is masked.
        findings: Findings of the reader, then of the checks.
    """

    outcome: str
    start: int
    stop: int
    masked: Mask
    findings: tuple[Finding, ...]


def inspect(log: Log, rate_hz: float, quality: "Quality") -> Inspected:
    """Check a recording, and determine which of its rows can be used.

    Args:
        log: The recording.
        rate_hz: Samples per second.
        quality: Thresholds.

    Raises:
        InputError: The samples are not three columns.
    """
    # here, as the calibrator uses the rest detector only, which needs no more than NumPy
    from gyro_pipeline.quality.recording import Recording  # noqa: PLC0415

    if log.samples.shape[1:] != (len(AXES),):
        raise InputError(f"expected samples of 3 axes, (n, 3), got shape {log.samples.shape}")
    recording = Recording(log, rate_hz, quality)
    for check in _checks():
        check(recording)
        if recording.rejected:
            break
    recording.trim()
    outcomes = [finding.outcome for finding in recording.findings]
    outcome = max(outcomes, key=(KEPT, REPAIRED, REJECTED).index, default=KEPT)
    masked, start = recording.masked, recording.start
    return Inspected(outcome, start, start + masked.size, masked, tuple(recording.findings))


def _checks() -> tuple[Callable[["Recording"], None], ...]:
    """The checks in their order: each may rely on what the earlier ones masked or rejected."""
    from gyro_pipeline.quality import masks, motion, values  # noqa: PLC0415 - as above

    return (
        # rows that hold no measurement
        masks.cut_zero_rows,
        masks.mask_non_finite,
        masks.mask_stuck,
        values.check_equal_axes,
        masks.mask_dropouts,
        masks.keep_longest_stretch,
        masks.require_length,
        # values that no gyroscope measures
        values.check_dead_band,
        values.check_repeats,
        values.check_steps,
        motion.check_bias,
        # disturbances, which the noise of blocks shows once the rows above are masked
        masks.mask_bursts,
        masks.require_length,
        values.check_levels,
        values.check_interleaved_devices,
        values.check_noise,
        # rest, once everything brief is masked
        motion.check_rest,
        motion.report_drift,
    )
