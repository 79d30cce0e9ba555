"""Checks for values that no gyroscope at rest measures."""

from itertools import combinations
from statistics import NormalDist

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from gyro_pipeline.conventions import AXES, IN_READER, MDPS
from gyro_pipeline.logs import KEPT, REJECTED
from gyro_pipeline.quality.recording import Recording, median
from gyro_pipeline.quality.rest import Array


def check_equal_axes(recording: Recording) -> None:
    """Reject two axes with the same values, where a column of the file was read twice."""
    for first, second in combinations(range(len(AXES)), 2):
        used = recording.used
        if used.size and np.array_equal(used[first], used[second]):
            detail = f"axes {AXES[first]} and {AXES[second]} have the same values"
            recording.add("equal axes", REJECTED, f"{detail}; correct `columns` {IN_READER}")


def check_repeats(recording: Recording, reported: float = 0.01, most: float = 0.2) -> None:
    """Reject rows that repeat the previous row, and axes that repeat values, beyond chance.

    By chance, axes repeat independently; their shares are measured where the axis with the fewest
    repeats does not repeat. For noise, the counts of changes by 0, 1 and 2 quantisation steps are
    log-concave: n0 n2 <= n1^2.
    """
    shares, same = recording.repeats, recording.changes == 0
    rarest = int(np.argmin(shares))
    if shares[rarest] > reported:
        others = np.delete(same, rarest, axis=0)[:, ~same[rarest]]
        chance = shares[rarest] * np.prod(others.mean(axis=1))
        share = (same.all(axis=0).mean() - chance) / (1 - chance)
        detail = f"{share:.1%} of the rows repeat the previous row"
        if share > most:
            detail += f", {1 / (1 - share):.3g} rows per sample; type `repeats: drop` {IN_READER}"
            recording.add("repeated rows", REJECTED, detail)
            return
        if share > reported + 4 * np.sqrt(chance / same.shape[1]):
            recording.add("repeated rows", KEPT, detail)
    for axis in np.flatnonzero(recording.steps):
        sizes = np.minimum(np.abs(recording.changes[axis]) / recording.steps[axis] + 0.5, 3)
        repeats, ones, twos, _ = np.bincount(sizes.astype(np.intp), minlength=4)
        share = (repeats - ones**2 / (2 * max(twos, 1))) / sizes.size
        if share > most:
            detail = f"axis {AXES[axis]} repeats {share:.0%} of its values beyond chance; log each "
            detail += "sample once, at the sensor's rate"
            recording.add("repeated values", REJECTED, detail)


def check_steps(recording: Recording) -> None:
    """Report or reject a quantisation step above the noise, on the coarsest axis."""
    steps, largest = recording.steps / MDPS, recording.quality.largest_step
    # rounding to a step adds step^2 / 12 to the variance (Sheppard)
    variances = median(recording.blocks.variances) / MDPS**2 - steps**2 / 12
    noise = np.sqrt(np.maximum(variances, 0))
    axis = np.argmax(steps - largest * noise)
    if steps[axis] > noise[axis]:
        detail = f"axis {AXES[axis]} has a step of {steps[axis]:.4g} mdps and a noise of "
        detail += f"{noise[axis]:.4g} mdps; a mean can be trusted up to {largest:g} times the noise"
        outcome = KEPT if steps[axis] <= largest * noise[axis] else REJECTED
        recording.add("coarse quantisation", outcome, f"{detail} (quality.largest_step)")


def check_dead_band(recording: Recording, least: int = 8) -> None:
    """Reject zeros that are too frequent, where small values or fractions of counts were cut."""
    for axis, rates in enumerate(recording.used):
        if np.count_nonzero(rates == 0) < least or not rates.min() < 0 < rates.max():
            continue
        values, _, excess = frequent_values(recording, axis)
        if (excess[values == 0] > 0).any():
            band, step = np.abs(values[values != 0]).min(), np.median(np.diff(values))
            cut = f"± {band:.2g} deg/s" if band > 1.5 * step else "counts cut to zero?"  # noqa: PLR2004
            detail = f"axis {AXES[axis]}, {cut}: 0 is {excess.max():.2g} times as frequent as its "
            detail += "neighbours; the mean is pulled to zero; log the raw rates"
            recording.add("dead band", REJECTED, detail)


def check_levels(recording: Recording, least: float = 3) -> None:
    """Reject a value far more frequent than its neighbours: saturation at an end, else a code.

    A value inside the range must be ``least`` times as frequent, since rounding twice can merge two
    values.
    """
    for axis, name in enumerate(AXES):
        values, counts, excess = frequent_values(recording, axis)
        excess[1:-1][excess[1:-1] < least] = 0
        if excess.any():
            most = excess.argmax()
            check, verb = "frequent value", "held"
            if most in {0, values.size - 1}:
                check, verb = "saturation", "cut off"
            detail = f"axis {name} is {verb} at {values[most]:.4g} deg/s, {counts[most]} times"
            recording.add(check, REJECTED, f"{detail}; the mean is pulled there")


def frequent_values(
    recording: Recording, axis: int, least: float = 1.5, most: int = 3
) -> tuple[Array, NDArray[np.integer], Array]:
    """Values, their counts, and the ratio of each count to that expected from its neighbours.

    The expected count is that of a cubic through the logarithms of the neighbours' counts, which is
    exact for normal noise on a fine grid and too large on a coarse one, or that of a line if this
    is larger. The ratio is 0 where chance explains it; runs count as independent samples. It is 0
    as well if more than ``most`` values are too frequent: such patterns, as of numbers that are
    rounded twice, do not move the mean.
    """
    # sorting is faster in float32, if the log has it
    ordered = np.sort(recording.used[axis].astype(recording.log.samples.dtype))
    if not np.any(ordered[7:] == ordered[:-7]):  # smaller counts are never beyond chance
        return np.zeros(0), np.zeros(0, np.intp), np.zeros(0)
    values, counts = np.unique(ordered, return_counts=True)
    if values.size < 3:  # noqa: PLR2004 - too few for neighbours on both sides
        return values, counts, np.zeros(values.size)
    # a tail continues beyond the ends with less than one count
    below, above = (np.clip(a**2 / b, 0.05, 0.5) for a, b in (counts[:2], counts[:-3:-1]))
    padded = np.array([below, below, *counts, above, above])
    second, first, _, third, fourth = sliding_window_view(padded, values.size)
    near, far = np.log(first) + np.log(third), np.log(second) + np.log(fourth)
    expected = np.exp(np.maximum(near / 2, (4 * near - far) / 6)) / counts
    repeated = recording.used[axis, 1:][recording.changes[axis] == 0]
    runs = counts - np.bincount(np.searchsorted(values, repeated), minlength=values.size)
    # twice the root of a count has a standard deviation of 1
    variance = (16 / first + 16 / third + 1 / second + 1 / fourth) / 36 * counts
    beyond = 2 * np.sqrt(runs) * (1 - np.sqrt(expected)) / np.sqrt(1 + expected * variance)
    limit = -NormalDist().inv_cdf(recording.quality.false_alarm / (len(AXES) * values.size))
    excess = np.where((beyond > limit) & (1 / expected >= least), 1 / expected, 0)
    return values, counts, excess * (np.count_nonzero(excess) <= most)


def check_interleaved_devices(recording: Recording) -> None:
    """Reject rows of several devices, whose levels alternate, or are far apart in any order."""
    widths = np.maximum(0.4 * np.sqrt(recording.squares), recording.steps)
    sizes = [jump_size(*axis) for axis in zip(recording.changes, widths, strict=True)]
    jumps = np.maximum(sizes, periodic_jumps(recording))
    if jumps.any():
        detail = f"axis {AXES[jumps.argmax()]} jumps by {jumps.max():.2g} deg/s from row to row; "
        detail += "several sensors in one file? Split it by device, or log a column that names the "
        detail += f"device and pick one by `rows: {{NAME: VALUE}}` {IN_READER}"
        recording.add("mixed rows", REJECTED, detail)


def periodic_jumps(recording: Recording, least: float = 0.5) -> Array:
    """Size of jumps that repeat with a period, (axis,), deg/s; 0 without such jumps.

    The periods have 2 to 16 devices in turn as divisors. The mean changes at each phase of a period
    differ by more than ``least`` times the noise and by more than chance. A single dominant
    frequency is a vibration, unless its period is 2 to 4 rows.
    """
    rates, squares, jumps = recording.filled, recording.squares, np.zeros(len(AXES))
    for period in (60, 56, 54, 44, 52, 48) if rates.shape[1] > 600 else (12,):  # noqa: PLR2004
        count = rates.shape[1] // period
        phases = rates[:, : count * period].reshape(len(AXES), count, period)
        levels = np.ones(count) @ phases / count
        means = np.diff(levels)
        sizes = np.ptp(means, axis=1) / 2
        within = np.maximum(squares - (means**2).mean(axis=1), 0.01 * squares) / (1 - 1 / count)
        beyond = sizes > max(least, 7 / np.sqrt(count)) * np.sqrt(within / 2)
        for axis in np.flatnonzero(beyond & (sizes > jumps)):
            cycle = np.diff(levels[axis], append=levels[axis, 0])
            powers = np.abs(np.fft.rfft(cycle)) ** 2
            main = powers.argmax()
            if main in {period / 2, period / 3, period / 4} or powers[main] < 0.9 * powers.sum():  # noqa: PLR2004
                jumps[axis] = sizes[axis]
    return jumps


def jump_size(changes: Array, width: float, hollow: float = 0.1, share: float = 0.02) -> float:
    """Size of jumps that are separated by a gap from small changes, (n - 1,); 0 without a gap.

    In the histogram of the sizes of changes, with bins of a ``width`` of at least a quantisation
    step, a bin holds less than ``hollow`` times a later one, which holds at least a ``share`` of
    all. Neither noise nor a vibration has such a gap.
    """
    counts = np.bincount((np.abs(changes) * (1 / width) + 0.5).astype(np.intp))
    later = np.maximum.accumulate(counts[::-1])[::-1]
    clear = np.sqrt(later) - np.sqrt(counts) > 4  # noqa: PLR2004 - roots of counts scatter by 1/2
    low = np.flatnonzero(clear & (counts < hollow * later) & (later > share * changes.size))
    return width * (low[-1] + np.argmax(counts[low[-1] :])) if low.size else 0.0


def check_noise(recording: Recording, least_mdps_rts: float = 0.2) -> None:
    """Reject too much noise, and report too little: the best MEMS have N of 0.33 mdps sqrt(s)."""
    # from changes rather than samples, as a slow swing is motion rather than noise
    sigma = np.sqrt(recording.squares.max() / 2)
    density = recording.blocks.noise.max() * np.sqrt(recording.size / recording.rate_hz) / MDPS
    largest = recording.quality.largest_noise_dps
    if sigma > largest:
        detail = f"{sigma:.3g} deg/s, expected at most {largest:g} for a gyroscope at rest; check "
        recording.add("noise level", REJECTED, f"{detail}the unit (quality.largest_noise_dps)")
    elif density < least_mdps_rts:
        detail = f"N is {density:.2g} mdps sqrt(s), less noise than any MEMS gyroscope has; check "
        recording.add("little noise", KEPT, f"{detail}the unit (`units` {IN_READER})")
