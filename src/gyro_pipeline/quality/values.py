"""Values that no gyroscope at rest gives, each told by a function of its own.

Rates are (axis, n), deg/s, finite; sigma is the standard deviation of a sample, (axis,), deg/s. A
check returns its finding, or none.
"""

from itertools import combinations

import numpy as np

from gyro_pipeline.conventions import AXES, MDPS
from gyro_pipeline.logs import KEPT, REJECTED, Finding
from gyro_pipeline.quality.blocks import Array

READER = "in `reader:` of the catalog entry in catalog.yml"


def check_axes(rates: Array) -> list[Finding]:
    """Two axes of the same values: one column was taken twice."""
    for i, j in combinations(range(len(AXES)), 2):
        if np.array_equal(rates[i], rates[j]):
            detail = (
                f"axes {AXES[i]} and {AXES[j]} have the same values: correct `columns` {READER}"
            )
            return [Finding("equal axes", REJECTED, detail)]
    return []


def check_repeats(rates: Array, reported: float = 0.01, most: float = 0.2) -> list[Finding]:
    """A share of rows that repeat the one before, beyond what chance makes of coarse axes."""
    same = rates[:, 1:] == rates[:, :-1]
    shares = np.count_nonzero(same, axis=1) / same.shape[1]
    if shares.min() <= reported:
        return []
    # an axis repeats by chance as often as where the one that repeats least does not
    rarest = int(np.argmin(shares))
    alone = np.delete(same, rarest, axis=0)[:, ~same[rarest]]
    chance = shares[rarest] * np.prod(alone.mean(axis=1)) if alone.size else 0.0
    share = (np.logical_and.reduce(same).mean() - chance) / (1 - chance)
    if share <= reported:
        return []
    detail = f"{share:.1%} of the rows repeat the one before"
    if share <= most:
        return [Finding("repeated rows", KEPT, detail)]
    detail += f": each sample is written {1 / (1 - share):.3g} times; type `repeats: drop` {READER}"
    return [Finding("repeated rows", REJECTED, detail)]


def check_turns(rates: Array, sigma: Array, least: float = 0.5, period: int = 12) -> list[Finding]:
    """Rows of levels in turn, ``period`` or a divisor of it, apart by ``least`` of the noise."""
    turns = rates[:, : rates.shape[1] // period * period].reshape(len(rates), -1, period)
    slope = (turns[:, -1].mean(axis=1) - turns[:, 0].mean(axis=1)) / rates.shape[1]
    trend = slope[:, None] * np.arange(period)

    def excess(levels: Array) -> Array:
        about = np.sqrt(np.maximum(sigma**2 - levels.var(axis=1), 0.01 * sigma**2))
        chance = 8 / np.sqrt(turns.shape[1])  # the range of so many means or medians, at most
        return np.ptp(levels, axis=1) - max(least, chance) * about

    if not (excess(turns.mean(axis=1) - trend) > 0).any():
        return []
    levels = np.median(turns, axis=1) - trend  # a shock moves no median
    axis = int(np.argmax(excess(levels)))
    if excess(levels)[axis] <= 0:
        return []
    size = np.ptp(levels[axis])
    ranges = {p: np.ptp(levels[axis].reshape(-1, p), axis=0).max() for p in (2, 3, 4, 6, 12)}
    every = min(p for p in ranges if ranges[p] < size / 2)
    detail = (
        f"every {every} rows axis {AXES[axis]} is at another level, {size:.3g} deg/s off: several "
        f"sensors in one file? Pick one by `rows: {{COLUMN: VALUE}}` {READER}"
    )
    return [Finding("alternating rows", REJECTED, detail)]


def check_zeros(rates: Array, least: int = 8) -> list[Finding]:
    """A dead band: ``least`` exact zeros or more, far more than of any value near, none between."""
    for axis in np.flatnonzero(np.count_nonzero(rates == 0, axis=1) >= least):
        sizes = np.abs(rates[axis][rates[axis] != 0])
        zeros, band = rates.shape[1] - sizes.size, sizes.min()
        near = np.round(sizes[sizes < 1.5 * band] / band, 3)
        counts = np.unique(near, return_counts=True)[1]
        # a quantisation step has one level there, noise far from zero more samples
        if counts.size > 2 and zeros > max(2 * counts.max(), near.size / 3):  # noqa: PLR2004
            detail = (
                f"axis {AXES[axis]} has {zeros} zeros in a dead band of ± {band:.2g} deg/s; the "
                "mean is pulled to zero. Record without it"
            )
            return [Finding("dead band", REJECTED, detail)]
    return []


def check_tops(rates: Array, least: int = 8, times: int = 4) -> list[Finding]:
    """A flat top: the extreme value is there ``least`` times, and twice as often as the next one.

    The tail of noise thins out instead. Behind a low-pass filter a peak lasts, but comes once, not
    ``times``. A step above 0.2 sigma hides a cut at 2 sigma, which shifts the mean by 0.008 sigma.
    """
    for sign, tops in ((1, rates.max(axis=1)), (-1, rates.min(axis=1))):
        at_top = rates == tops[:, None]
        for axis in np.flatnonzero(np.count_nonzero(at_top, axis=1) >= least):
            count, below = np.count_nonzero(at_top[axis]), sign * rates[axis][~at_top[axis]]
            if not below.size or below.min() == below.max():
                continue  # of two values alone, the step is too coarse to speak of tails
            came = np.count_nonzero(at_top[axis][1:] & ~at_top[axis][:-1])
            if count >= 2 * np.count_nonzero(below == below.max()) and came >= times:
                detail = f"axis {AXES[axis]} is cut off at {tops[axis]:.4g} deg/s, {count} times"
                return [Finding("saturation", REJECTED, f"{detail}; the mean is pulled from there")]
    return []


def check_steps(rates: Array, sigma: Array, largest: float, reported: float = 1.0) -> list[Finding]:
    """The coarsest axis, if its quantisation step is above ``reported`` times the noise."""
    steps, changes = np.zeros(len(rates)), np.abs(np.diff(rates, axis=1))
    # white noise repeats a tenth of its samples at a step of 0.36 sigma
    for axis in np.flatnonzero(np.count_nonzero(changes == 0, axis=1) > 0.1 * changes.shape[1]):
        # a few values that lie off the grid, as interpolated ones do, are below the quantile
        steps[axis] = np.quantile(changes[axis][changes[axis] > 0], 0.01, method="lower")
    # rounding to a step adds step^2 / 12 to the variance (Sheppard)
    noise = np.sqrt(np.maximum(sigma**2 - steps**2 / 12, 0))
    axis = np.argmax(steps - largest * noise)
    if steps[axis] <= noise[axis]:
        return []
    detail = (
        f"axis {AXES[axis]} has a step of {steps[axis] / MDPS:.4g} mdps beside a noise of "
        f"{noise[axis] / MDPS:.4g} mdps; a mean can be trusted up to {largest:g} times the noise "
        "(quality.largest_step)"
    )
    outcome = KEPT if steps[axis] <= largest * noise[axis] else REJECTED
    return [Finding("coarse quantisation", outcome, detail)]


def check_noise(
    rates: Array, density: Array, largest_dps: float, least_mdps_rts: float = 0.2
) -> list[Finding]:
    """More noise of a sample, or less N, than a MEMS gyroscope has; the best have 0.02 deg/sqrt(h).

    ``density`` is N, (axis,), in deg/s sqrt(s); 0.02 deg/sqrt(h) are 0.33 mdps sqrt(s).
    """
    steps = np.diff(rates, axis=1)  # not the samples: a swing is a motion, and no noise
    sigma = np.sqrt(np.einsum("as,as->a", steps, steps) / (2 * steps.shape[1]))
    axis = int(np.argmax(sigma))
    if sigma[axis] > largest_dps:
        detail = (
            f"axis {AXES[axis]} has a noise of {sigma[axis]:.3g} deg/s; expected at most "
            f"{largest_dps:g} of a gyroscope at rest (check the unit; quality.largest_noise_dps)"
        )
        return [Finding("noise level", REJECTED, detail)]
    if density.max() >= least_mdps_rts * MDPS:
        return []
    detail = (
        f"N is {density.max() / MDPS:.2g} mdps sqrt(s), less noise than any MEMS gyroscope has; "
        f"check the unit (`units` {READER})"
    )
    return [Finding("little noise", KEPT, detail)]
