"""Quality control of one recording: was it at rest, and which of its rows hold a measurement?

A recording goes through steps until one rejects it; each of them says what it looks for. What
is brief is masked and does not end the recording; a gap in time does. Limits know how many samples
they compare. Motion rejects all of a recording: rates alone do not tell which part was at rest, and
after a turn the Earth's rate falls differently on the axes.

Not told are a rotation as steady as a bias, steps of 0.1 deg/s up and down every few seconds, and
sways of 0.05 deg/s or, of any size, of a period of one or two blocks. Neither are several devices
in random order that are less than about 8 sigma apart, nor those in turn where rows slip and they
are less than about 4 sigma apart. More than 16 devices in turn may be missed; a steady vibration at
a half, a third or a quarter of the sample rate is taken for devices.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from gyro_pipeline.conventions import AXES, InputError
from gyro_pipeline.logs import KEPT, REJECTED, REPAIRED, Finding, Log
from gyro_pipeline.quality.rest import Mask

if TYPE_CHECKING:
    from gyro_pipeline.parameters import Quality


@dataclass(frozen=True)
class Inspected:
    """What quality control says about a recording.

    Attributes:
        outcome: KEPT, REPAIRED or REJECTED, the worst that a finding ends in.
        start: First sample of the log that makes the recording, 0-based.
        stop: The sample after its last; equal to ``start`` if there is none.
        masked: (stop - start,), rows in it that hold no measurement.
        findings: Of the reading, then of the checks.
    """

    outcome: str
    start: int
    stop: int
    masked: Mask
    findings: tuple[Finding, ...]


def inspect(log: Log, rate_hz: float, quality: "Quality") -> Inspected:
    """Judge a recording of so many samples a second, and say which of its rows can be used.

    Raises:
        InputError: If the samples are not three columns.
    """
    # the calibrator shares the test of rest, and needs NumPy alone for it
    from gyro_pipeline.quality import masks, motion, values  # noqa: PLC0415
    from gyro_pipeline.quality.recording import Recording  # noqa: PLC0415

    if log.samples.shape[1:] != (len(AXES),):
        raise InputError(f"expected samples of 3 axes, (n, 3), got shape {log.samples.shape}")
    recording = Recording(log, rate_hz, quality)
    for step in (
        *(masks.cut_zero_rows, masks.mask_non_finite, masks.mask_stuck, values.check_equal_axes),
        *(masks.mask_dropouts, masks.keep_longest_stretch, masks.require_length),
        *(values.check_dead_band, values.check_repeats, values.check_steps, motion.check_bias),
        *(masks.mask_bursts, masks.require_length, values.check_levels, values.check_turns),
        *(values.check_noise, motion.check_rest, motion.report_drift),
    ):
        step(recording)
        if recording.rejected:
            break
    recording.trim()
    outcomes = [finding.outcome for finding in recording.findings]
    outcome = max(outcomes, key=(KEPT, REPAIRED, REJECTED).index, default=KEPT)
    masked, start = recording.masked, recording.start
    return Inspected(outcome, start, start + masked.size, masked, tuple(recording.findings))
