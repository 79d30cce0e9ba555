"""Damage that a logger or a converter does to samples, found in the values themselves."""

import numpy as np
from numpy.typing import NDArray
from scipy import special

FLAT_TOP = 8
"""Samples at an extreme value that make it a limit, if they are twice as many as at the next value.
One of 18,000 axes of Gaussian noise has them, at a step of 0.2 sigma (benchmarks/quality.py)."""

_TIMES, _FAR = 4, 3
"""Times that a limit is reached; or else usual changes from sample to sample, from the top of a
clipped shock to the next value."""

_QUANTISED = 0.1
"""Share of samples that equal the one before: white noise has it at a step of 0.36 sigma."""

_STEP_QUANTILE = 0.01
"""Of the changes from sample to sample: the step, where there is one; a few values that lie off its
grid, as interpolated ones do, are below."""


def rows_between_zeros(rates: NDArray[np.float64]) -> tuple[int, int]:
    """First row that is not zero on every axis, and the row after the last; equal if all are.

    Args:
        rates: (axis, n).
    """
    rows = np.flatnonzero(rates.any(axis=0))
    return (int(rows[0]), int(rows[-1]) + 1) if rows.size else (rates.shape[1], rates.shape[1])


def dropouts(rates: NDArray[np.float64], false_alarm: float) -> NDArray[np.bool_]:
    """Rows that a lost packet left behind: finite, beyond the noise, and telling by their place.

    They stand beside a non-finite row, where a logger halved a sample, or are zero on every axis.

    Args:
        rates: (axis, n), deg/s.
        false_alarm: Probability that white Gaussian noise has a row beyond it.

    Returns:
        (n,).
    """
    finite = np.isfinite(rates).all(axis=0)
    lost = np.pad(~finite, 1)
    suspect = finite & (lost[:-2] | lost[2:] | ~np.any(rates, axis=0))
    if not suspect.any() or np.count_nonzero(finite) == 1:  # of a single row there is no noise
        return np.zeros_like(finite)
    good = rates[:, finite]
    level = np.median(good, axis=1, keepdims=True)
    # of |d|, d normal with variance 2 sigma^2, the median is 0.6745 sqrt(2) sigma
    steps = np.median(np.abs(np.diff(good, axis=1)), axis=1, keepdims=True)
    sigma = steps / (special.ndtri(0.75) * np.sqrt(2))
    limit = -special.ndtri(false_alarm / (2 * rates.size)) * sigma
    rows = np.flatnonzero(suspect)
    suspect[rows] = (np.abs(rates[:, rows] - level) > limit).any(axis=0)
    return suspect


def stuck(rates: NDArray[np.float64], least: int, false_alarm: float) -> NDArray[np.bool_]:
    """Samples in a run of equal ones that is longer than chance allows.

    Where a sample equals the one before with probability p, n samples hold a run of more than k
    with a probability of at most n p^k. p is the axis's own, from its samples outside the longest
    run, so a coarse quantisation allows longer runs.

    Args:
        rates: (axis, n), deg/s; NaN equals nothing.
        least: Shorter runs are let pass: a packet that is sent twice harms no mean.
        false_alarm: Probability that an axis has any such run at rest.

    Returns:
        (axis, n).
    """
    found = np.zeros(rates.shape, bool)
    same = rates[:, 1:] == rates[:, :-1]
    for axis in np.flatnonzero(np.count_nonzero(same, axis=1) + 1 >= least):
        edges = np.concatenate([[0], np.flatnonzero(~same[axis]) + 1, [rates.shape[1]]])
        lengths = np.diff(edges)
        others = lengths.sum() - lengths.max()
        equal = others - (lengths.size - 1)
        p = (equal + 1) / (others + 2)  # Laplace's: never 0 or 1
        allowed = max(least - 1, np.log(false_alarm / rates.shape[1]) / np.log(p))
        found[axis] = np.repeat(lengths > allowed, lengths)
    return found


def repeated_rows(rates: NDArray[np.float64]) -> float:
    """Share of rows that repeat the one before on all axes, beyond what chance makes of the axes.

    Args:
        rates: (axis, n), deg/s.
    """
    same = rates[:, 1:] == rates[:, :-1]
    shares = np.count_nonzero(same, axis=1) / same.shape[1]
    if shares.min() == 0:  # as in most recordings
        return 0.0
    return float(np.logical_and.reduce(same).mean() - np.prod(shares))


def saturated(rates: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Samples at the largest or smallest value of an axis, where that is a limit.

    The tail of noise thins out; where it is cut off, the last value occurs far more often than the
    one before it. A step above 0.2 sigma hides a cut at 2 sigma, which shifts the mean by 0.008.

    Args:
        rates: (axis, n), deg/s; may hold NaN, but no axis of nothing else.

    Returns:
        (axis, n).
    """
    found = np.zeros(rates.shape, bool)
    for sign, extreme in ((1, np.fmax), (-1, np.fmin)):
        tops = extreme.reduce(rates, axis=1)
        at_top = rates == tops[:, None]
        for axis in np.flatnonzero(np.count_nonzero(at_top, axis=1) >= FLAT_TOP):
            below = sign * rates[axis][sign * rates[axis] < sign * tops[axis]]
            # one more value at least: of two alone, the step is too coarse to speak of tails
            if not below.size or below.min() == below.max():
                continue
            if np.count_nonzero(at_top[axis]) < 2 * np.count_nonzero(
                rates[axis] == sign * below.max()
            ):
                continue
            # behind a low-pass filter a peak lasts, but comes once, and what is next is near
            usual = np.nanmedian(np.abs(np.diff(rates[axis])))
            far = sign * tops[axis] - below.max() > _FAR * usual
            if far or _runs(at_top[axis]) >= _TIMES:
                found[axis] |= at_top[axis]
    return found


def _runs(where: NDArray[np.bool_]) -> int:
    """Runs of true values, (n,)."""
    return int(where[0]) + int(np.count_nonzero(where[1:] & ~where[:-1]))


def quantisation_steps(rates: NDArray[np.float64]) -> NDArray[np.float64]:
    """Step between neighbouring values of each axis, where it is coarse enough to matter.

    Args:
        rates: (axis, n), deg/s, finite.

    Returns:
        (axis,), deg/s; 0 for an axis that hardly ever repeats a value.
    """
    steps = np.zeros(len(rates))
    same = np.count_nonzero(rates[:, 1:] == rates[:, :-1], axis=1)
    for axis in np.flatnonzero(same > _QUANTISED * (rates.shape[1] - 1)):
        changes = np.abs(np.diff(rates[axis]))
        if changes.any():
            steps[axis] = np.quantile(changes[changes > 0], _STEP_QUANTILE, method="lower")
    return steps


def longest_stretch(usable: NDArray[np.bool_], gap_rows: NDArray[np.integer]) -> tuple[int, int]:
    """First row of the longest run of usable rows without a gap, and the row after its last.

    Args:
        usable: (n,).
        gap_rows: Rows before which samples are missing.

    Returns:
        The first of equally long ones; equal rows if none is usable.
    """
    bad = np.flatnonzero(~usable)
    starts = np.sort(np.concatenate([[0], bad + 1, gap_rows]))
    stops = np.sort(np.concatenate([bad, gap_rows, [usable.size]]))
    longest = int(np.argmax(stops - starts))
    return int(starts[longest]), int(max(starts[longest], stops[longest]))
