"""Checks for motion: at rest the bias may drift smoothly, but nothing else changes.

Means of blocks are (axis, block), their noise is a standard deviation, (axis,), both in deg/s.
"""

from statistics import NormalDist

import numpy as np

from gyro_pipeline.conventions import AXES, MDPS
from gyro_pipeline.logs import KEPT, REJECTED
from gyro_pipeline.quality.recording import Recording, median
from gyro_pipeline.quality.rest import Array, Mask, RestDetector


def check_bias(recording: Recording, least_dps: float = 3e-3, longest: int = 8) -> None:
    """Reject a level that goes to zero on all axes at once, as the sensor subtracts its bias.

    A mean below ``least_dps``, or up to four times that if noise requires it, counts as zero. A
    warm-up takes more than ``longest`` blocks from 80 to 20 % of the level.
    """
    means, noise = recording.blocks.means, recording.blocks.noise
    late = means[:, -max(means.shape[1] // 4, 1) :]
    zero = np.clip(4 * noise / np.sqrt(late.shape[1]), least_dps, 4 * least_dps)
    level = median(recording.filled[:, : recording.size])  # a knock moves the mean
    nonzero = np.abs(level) > np.maximum(10 * zero, 5 * noise)
    if np.count_nonzero(nonzero) > 1 and (np.abs(late.mean(axis=1)) < zero).all():
        axis = np.argmax(np.abs(level))
        falling = np.abs(means[axis] / level[axis] - 0.5) < 0.3  # noqa: PLR2004
        if np.count_nonzero(falling) <= longest:
            detail = "the sensor subtracts its bias on all axes; log its uncorrected rates"
            recording.add("bias subtracted", REJECTED, detail)


def fit_drift(recording: Recording, shortest: float = 0.5) -> Array:
    """Fit a drift, (axis, block), by least squares: decays of the same sign, and a line.

    The drift of an axis is 0 if no decay and no line is significant by itself, which happens in
    white noise with probability ``false_alarm``, or if a single step explains more, as this is a
    movement. Time constants are at least ``shortest`` blocks.
    """
    starts, means, _, _, noise = recording.blocks
    times = (starts - starts[0]) / recording.size
    constants = shortest * 2.0 ** np.arange(np.ceil(np.log2(2 * times[-1] / shortest)))
    shapes = np.vstack([np.exp(-times / constants[:, None]), times, -times])
    shapes -= shapes.mean(axis=1, keepdims=True)
    shapes /= np.linalg.norm(shapes, axis=1, keepdims=True)
    rates, drift = means - means.mean(axis=1, keepdims=True), np.zeros_like(means)
    scores = np.abs(rates @ shapes.T) / noise[:, None]
    limit = -NormalDist().inv_cdf(recording.quality.false_alarm / (2 * scores.size))
    before = np.arange(1, times.size)
    for axis in np.flatnonzero(scores.max(axis=1) > limit):
        from scipy import optimize  # noqa: PLC0415 - imported slowly, and few recordings drift

        fits = [(sign, *optimize.nnls(shapes.T, sign * rates[axis])) for sign in (1, -1)]
        sign, weights, residual = min(fits, key=lambda fit: fit[2])
        steps = np.cumsum(rates[axis])[:-1] ** 2 * (1 / before + 1 / before[::-1])
        if rates[axis] @ rates[axis] - residual**2 > steps.max():
            drift[axis] = sign * weights @ shapes
    return drift


def check_rest(recording: Recording) -> None:
    """Reject a drift too large for a bias, and other changes of the mean or the noise."""
    blocks, q, drift = recording.blocks, recording.quality, fit_drift(recording)
    sizes, residuals = np.ptp(drift, axis=1), blocks.means - drift
    moved, noisier = alarms(recording, residuals)
    if sizes.max() > q.largest_drift_dps:
        detail = f"the rate drifts by {sizes.max():.2g} deg/s, axis {AXES[sizes.argmax()]}; a bias "
        detail += f"by at most {q.largest_drift_dps:g} (quality.largest_drift_dps)"
    elif moved:
        changes = np.abs(residuals - median(residuals)[:, None])
        axis, rows = evidence(recording, changes / (q.least_change_dps + 6 * blocks.noise[:, None]))
        detail = f"the rate changes by up to {changes[axis].max():.2g} deg/s, axis {AXES[axis]}, "
        detail += f"{rows}; a bias by at most {q.least_change_dps:g} (quality.least_change_dps)"
    elif noisier.any():
        rise = np.sqrt(blocks.variances) / blocks.sigma[:, None]
        axis, rows = evidence(recording, rise * noisier)
        detail = f"the noise rises up to {rise[axis].max():.2g}-fold, axis {AXES[axis]}, {rows}"
    else:
        return
    recording.add("motion", REJECTED, detail)


def alarms(recording: Recording, residuals: Array) -> tuple[bool, Mask]:
    """Whether residuals from the drift change, and in which blocks, (block,), the noise rises."""
    q, axes = recording.quality, len(AXES)
    detector = RestDetector(recording.size, q.false_alarm, q.least_change_dps)
    # forwards and backwards, as the first blocks have few earlier blocks for comparison
    series = (np.vstack([x, x[:, ::-1]]).T for x in (residuals, recording.blocks.variances))
    moved, noisier = detector.update(*series)
    return bool(moved.any()), np.any(noisier[:, :axes] | noisier[::-1, axes:], axis=1)


def evidence(recording: Recording, excess: Array) -> tuple[int, str]:
    """Axis of the largest excess, (axis, block), and the rows of the blocks where it exceeds 1."""
    chosen = (excess >= min(1, excess.max())).any(axis=0)
    rows = np.zeros_like(recording.masked)
    rows[recording.blocks.starts[chosen, None] + np.arange(recording.size)] = True
    return int(excess.max(axis=1).argmax()), recording.where(rows)


def report_drift(recording: Recording, parts: int = 10) -> None:
    """Report a level that moves between tenths: a warm-up if it settles in the last three."""
    means, noise = recording.blocks.means, recording.blocks.noise
    edges = np.linspace(0, means.shape[1], parts + 1).astype(np.intp)
    levels = np.add.reduceat(means, edges[:-1], axis=1) / np.diff(edges)
    chance = 8 * noise / np.sqrt(means.shape[1] // parts)  # upper limit of their range
    moves, late = np.ptp(levels, axis=1), np.ptp(levels[:, -3:], axis=1)
    for axis in np.flatnonzero(moves > np.maximum(recording.quality.drift_mdps * MDPS, chance)):
        settled = late[axis] < max(0.15 * moves[axis], chance[axis] / 2)
        check, end = ("warm-up", "settled") if settled else ("drift", "not settled at the end")
        detail = f"axis {AXES[axis]} by {moves[axis] / MDPS:.3g} mdps, {end}"
        recording.add(check, KEPT, detail)
