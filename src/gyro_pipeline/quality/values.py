"""Values that no gyroscope at rest gives, each told by a function of its own."""

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from gyro_pipeline.conventions import AXES, MDPS
from gyro_pipeline.logs import KEPT, REJECTED, Finding

Rates = NDArray[np.float64]
"""(axis, n), deg/s, finite."""


def check_axes(rates: Rates) -> list[Finding]:
    """Two axes of the same values: one column was taken twice."""
    return [
        Finding(
            "equal axes", REJECTED, f"axes {AXES[i]} and {AXES[j]} have the same values: {_COLUMNS}"
        )
        for i, j in combinations(range(len(AXES)), 2)
        if np.array_equal(rates[i], rates[j])
    ][:1]


_COLUMNS = "correct `columns` in `reader:` of the catalog entry in catalog.yml"


def check_repeats(rates: Rates, reported: float = 0.01, most: float = 0.2) -> list[Finding]:
    """Rows that repeat the one before, beyond what chance makes of coarse axes.

    Args:
        rates: (axis, n).
        reported: Share of the rows.
        most: Share of the rows; noise and standard error of more are wrong.
    """
    same = rates[:, 1:] == rates[:, :-1]
    counts = np.count_nonzero(same, axis=1)
    if counts.min() <= reported * same.shape[1]:
        return []
    # an axis repeats by chance as often as where the axis that repeats least does not
    rarest = same[np.argmin(counts)]
    others = np.delete(same, np.argmin(counts), axis=0)[:, ~rarest]
    chance = counts.min() / rarest.size * (others.mean(axis=1).prod() if others.size else 0.0)
    together = np.logical_and.reduce(same).mean()
    share = (together - chance) / (1 - chance)
    if share <= reported:
        return []
    detail = f"{share:.3g} of the rows repeat the one before"
    if share <= most:
        return [Finding("repeated rows", KEPT, detail)]
    detail += (
        f": each sample is written {1 / (1 - share):.3g} times, so the rate is not the sensor's; "
        "type `repeats: drop` in `reader:` of the catalog entry in catalog.yml"
    )
    return [Finding("repeated rows", REJECTED, detail)]


def check_turns(rates: Rates, sigma: Rates, least: float = 0.5, period: int = 12) -> list[Finding]:
    """Rows of several levels in turn, two to four or any divisor of ``period``.

    Args:
        rates: (axis, n).
        sigma: (axis,), of a sample.
        least: Difference of the levels over the noise about them.
        period: Rows after which the turns begin again.
    """
    inside = rates[:, : rates.shape[1] // period * period].reshape(len(rates), -1, period)
    chance = 8 / np.sqrt(max(inside.shape[1], 1))  # the range of so many means, at most

    def apart(levels: Rates) -> Rates:
        about = np.sqrt(np.maximum(sigma**2 - levels.var(axis=1), 0.01 * sigma**2))
        return np.ptp(levels, axis=1) - max(least, chance) * about

    if inside.shape[1] < period or (apart(inside.mean(axis=1)) <= 0).all():
        return []
    levels = np.median(inside, axis=1)  # shocks and steps move no median
    excess = apart(levels)
    if (excess <= 0).all():
        return []
    axis = int(np.argmax(excess))
    fits = [p for p in (2, 3, 4, 6, 12) if period % p == 0]
    spread = [np.ptp(levels[axis].reshape(-1, p), axis=0).max() for p in fits]
    p = fits[int(np.argmax(np.array(spread) <= 0.5 * np.ptp(levels[axis])))]
    detail = (
        f"rows take turns between levels up to {np.ptp(levels[axis]):.3g} deg/s apart, every {p}, axis "
        f"{AXES[axis]}: several sensors in one file; split it, or pick one by `rows: {{COLUMN: VALUE}}` "
        "in `reader:` of the catalog entry in catalog.yml"
    )
    return [Finding("alternating rows", REJECTED, detail)]


def check_zeros(rates: Rates, least: int = 8) -> list[Finding]:
    """A dead band: far more exact zeros than any value near it, and none between.

    Args:
        rates: (axis, n).
        least: Zeros on an axis that are looked at.
    """
    for axis in np.flatnonzero(np.count_nonzero(rates == 0, axis=1) >= least):
        sizes = np.abs(rates[axis])
        zeros, sizes = np.count_nonzero(sizes == 0), sizes[sizes > 0]
        if not sizes.size:
            continue
        band = sizes.min()
        near = sizes[sizes < 1.5 * band]
        # a step of quantisation has one level there
        counts = np.unique(np.round(near / band, 3), return_counts=True)[1]
        if counts.size > 2 and zeros > max(2 * counts.max(), near.size / 3):  # noqa: PLR2004
            detail = (
                f"axis {AXES[axis]} has {zeros} zeros and no other value within a dead band of "
                f"± {band:.2g} deg/s; the mean is pulled to zero. Record without the dead band"
            )
            return [Finding("dead band", REJECTED, detail)]
    return []


def check_top(rates: Rates, least: int = 8, times: int = 4) -> list[Finding]:
    """A flat top: the largest or smallest value recurs as no tail of noise does.

    The tail of noise thins out; where it is cut off, the last value is there far more often than the
    one before it. A step above 0.2 sigma hides a cut at 2 sigma, which shifts the mean by 0.008.

    Args:
        rates: (axis, n).
        least: Samples at the extreme value, if twice as many as at the next.
        times: Runs of them: behind a low-pass filter a peak lasts, but comes once.
    """
    for sign, tops in ((1, rates.max(axis=1)), (-1, rates.min(axis=1))):
        at_top = rates == tops[:, None]
        for axis in np.flatnonzero(np.count_nonzero(at_top, axis=1) >= least):
            below = sign * rates[axis][~at_top[axis]]
            if not below.size or below.min() == below.max():
                continue  # of two values alone, the step is too coarse to speak of tails
            count = np.count_nonzero(at_top[axis])
            runs = np.count_nonzero(np.diff(at_top[axis].astype(np.int8)) == 1)
            if count >= 2 * np.count_nonzero(below == below.max()) and runs >= times:
                detail = f"axis {AXES[axis]} is cut off at {tops[axis]:.4g} deg/s, {count} times"
                return [Finding("saturation", REJECTED, f"{detail}; the mean is pulled from there")]
    return []


def check_steps(
    rates: Rates, sigma: Rates, largest: float, reported: float = 1.0, repeats: float = 0.1
) -> list[Finding]:
    """The coarsest axis, if its quantisation step is not small beside the noise.

    Args:
        rates: (axis, n).
        sigma: (axis,), of a sample.
        largest: Step over noise up to which a mean can be trusted.
        reported: Step over noise.
        repeats: Share of samples that equal the one before: white noise has it at 0.36 sigma.
    """
    steps = np.zeros(len(rates))
    changes = np.abs(np.diff(rates, axis=1))
    for axis in np.flatnonzero(np.count_nonzero(changes == 0, axis=1) > repeats * changes.shape[1]):
        # a few values that lie off the grid, as interpolated ones do, are below the quantile
        steps[axis] = np.quantile(changes[axis][changes[axis] > 0], 0.01, method="lower")
    # rounding to a step adds step^2 / 12 to the variance (Sheppard)
    noise = np.sqrt(np.maximum(sigma**2 - steps**2 / 12, 0))
    coarse = np.flatnonzero(steps > reported * noise)
    if not coarse.size:
        return []
    axis = coarse[np.argmax(steps[coarse] - largest * noise[coarse])]
    outcome = KEPT if steps[axis] <= largest * noise[axis] else REJECTED
    detail = (
        f"axis {AXES[axis]} has a step of {steps[axis] / MDPS:.4g} mdps beside a noise of "
        f"{noise[axis] / MDPS:.4g} mdps; a mean can be trusted up to {largest:g} times the noise "
        "(quality.largest_step)"
    )
    return [Finding("coarse quantisation", outcome, detail)]


def check_noise(
    rates: Rates, density: Rates, largest_dps: float, least_mdps_rts: float = 0.2
) -> list[Finding]:
    """More noise from sample to sample, or less in all, than a MEMS gyroscope at rest has.

    Args:
        rates: (axis, n).
        density: (axis,), N, deg/s sqrt(s).
        largest_dps: Standard deviation of a sample.
        least_mdps_rts: N; the best MEMS gyroscopes have 0.3 (0.02 deg/sqrt(h)).
    """
    steps = np.diff(rates, axis=1)  # a swing is smooth: it is a motion, and no noise
    sigma = np.sqrt(np.einsum("as,as->a", steps, steps) / (2 * steps.shape[1]))
    if sigma.max() > largest_dps:
        axis = int(np.argmax(sigma))
        detail = (
            f"axis {AXES[axis]} has a noise of {sigma[axis]:.3g} deg/s; expected at most "
            f"{largest_dps:g} of a gyroscope at rest (check the unit; quality.largest_noise_dps)"
        )
        return [Finding("noise level", REJECTED, detail)]
    if density.max() < least_mdps_rts * MDPS:
        detail = (
            f"N is {density.max() / MDPS:.2g} mdps sqrt(s), less noise than any MEMS gyroscope has; check "
            "the unit (`units` in `reader:` of the catalog entry in catalog.yml)"
        )
        return [Finding("little noise", KEPT, detail)]
    return []
