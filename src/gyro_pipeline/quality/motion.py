"""At rest or not: a bias may drift smoothly, and what is left of the rates changes in nothing.

Means of blocks are (axis, block), noise is the standard deviation of one, (axis,), both in deg/s.
"""

from statistics import NormalDist

import numpy as np

from gyro_pipeline.conventions import AXES, MDPS
from gyro_pipeline.logs import KEPT, REJECTED
from gyro_pipeline.quality.recording import Recording, median
from gyro_pipeline.quality.rest import Array, Mask, RestDetector


def check_bias(recording: Recording, least_dps: float = 3e-3, longest: int = 8) -> None:
    """A level that goes to zero on all axes at once: the sensor takes its bias off by itself.

    A mean below ``least_dps``, or up to four times that where noise needs it, is zero. A warm-up is
    on its way from 80 to 20 % for more than ``longest`` blocks.
    """
    means, noise = recording.blocks.means, recording.blocks.noise
    late = means[:, -max(means.shape[1] // 4, 1) :]
    zero = np.clip(4 * noise / np.sqrt(late.shape[1]), least_dps, 4 * least_dps)
    level = median(recording.filled[:, : recording.size])  # a knock moves the mean
    off = np.abs(level) > np.maximum(10 * zero, 5 * noise)
    if np.count_nonzero(off) > 1 and (np.abs(late.mean(axis=1)) < zero).all():
        axis = np.argmax(np.abs(level))
        on_its_way = np.abs(means[axis] / level[axis] - 0.5) < 0.3  # noqa: PLR2004
        if np.count_nonzero(on_its_way) <= longest:
            detail = "the sensor takes its level to zero on all axes; log its raw rates"
            recording.add("bias taken off", REJECTED, detail)


def fit_drift(recording: Recording, shortest: float = 0.5) -> Array:
    """Fit decays of one sign from the first block on, and a line, by least squares: (axis, block).

    An axis has no drift, 0, if none of them is significant by itself, which white noise is with a
    probability of ``false_alarm``, or if a single step explains more: that is a movement. No decay
    is faster than ``shortest``, in blocks.
    """
    starts, means, _, _, noise = recording.blocks
    times = (starts - starts[0]) / recording.size
    slow = shortest * 2.0 ** np.arange(np.ceil(np.log2(2 * times[-1] / shortest)))
    shapes = np.vstack([np.exp(-times / slow[:, None]), times, -times])
    shapes -= shapes.mean(axis=1, keepdims=True)
    shapes /= np.linalg.norm(shapes, axis=1, keepdims=True)
    rates, drift = means - means.mean(axis=1, keepdims=True), np.zeros_like(means)
    alone = np.abs(rates @ shapes.T) / noise[:, None]
    limit = -NormalDist().inv_cdf(recording.quality.false_alarm / (2 * alone.size))
    before = np.arange(1, times.size)
    for axis in np.flatnonzero(alone.max(axis=1) > limit):
        from scipy import optimize  # noqa: PLC0415 - it starts slowly, and most have no drift

        fits = [(sign, *optimize.nnls(shapes.T, sign * rates[axis])) for sign in (1, -1)]
        sign, weights, left = min(fits, key=lambda fit: fit[2])
        steps = np.cumsum(rates[axis])[:-1] ** 2 * (1 / before + 1 / before[::-1])
        if rates[axis] @ rates[axis] - left**2 > steps.max():
            drift[axis] = sign * weights @ shapes
    return drift


def check_rest(recording: Recording) -> None:
    """A drift too large for a bias, or a mean or a noise that changes beside the drift."""
    blocks, q, drift = recording.blocks, recording.quality, fit_drift(recording)
    sizes, left = np.ptp(drift, axis=1), blocks.means - drift
    moved, noisier = alarms(recording, left)
    if sizes.max() > q.largest_drift_dps:
        detail = f"the rate drifts by {sizes.max():.2g} deg/s, axis {AXES[sizes.argmax()]}; a bias "
        detail += f"by at most {q.largest_drift_dps:g} (quality.largest_drift_dps)"
    elif moved:
        apart = np.abs(left - median(left)[:, None])
        axis, rows = evidence(recording, apart / (q.least_change_dps + 6 * blocks.noise[:, None]))
        detail = f"the rate changes by up to {apart[axis].max():.2g} deg/s, axis {AXES[axis]}, "
        detail += f"{rows}; a bias by at most {q.least_change_dps:g} (quality.least_change_dps)"
    elif noisier.any():
        rise = np.sqrt(blocks.variances) / blocks.sigma[:, None]
        axis, rows = evidence(recording, rise * noisier)
        detail = f"the noise rises up to {rise[axis].max():.2g}-fold, axis {AXES[axis]}, {rows}"
    else:
        return
    recording.add("motion", REJECTED, detail)


def alarms(recording: Recording, left: Array) -> tuple[bool, Mask]:
    """Whether the mean changes beside the drift; and (block,) whether the noise rises."""
    q, axes = recording.quality, len(AXES)
    detector = RestDetector(recording.size, q.false_alarm, q.least_change_dps)
    # forwards and backwards: its first blocks have little before them to be compared with
    series = (np.vstack([x, x[:, ::-1]]).T for x in (left, recording.blocks.variances))
    moved, noisier = detector.update(*series)
    return bool(moved.any()), np.any(noisier[:, :axes] | noisier[::-1, axes:], axis=1)


def evidence(recording: Recording, excess: Array) -> tuple[int, str]:
    """Axis of the largest excess, (axis, block), and rows of blocks where it is above 1."""
    chosen = (excess >= min(1, excess.max())).any(axis=0)
    rows = np.zeros_like(recording.masked)
    rows[recording.blocks.starts[chosen, None] + np.arange(recording.size)] = True
    return int(excess.max(axis=1).argmax()), recording.where(rows)


def report_drift(recording: Recording, parts: int = 10) -> None:
    """A level that moves from tenth to tenth: a warm-up if hardly in the last three, or a drift."""
    means, noise = recording.blocks.means, recording.blocks.noise
    edges = np.linspace(0, means.shape[1], parts + 1).astype(np.intp)
    levels = np.add.reduceat(means, edges[:-1], axis=1) / np.diff(edges)
    chance = 8 * noise / np.sqrt(means.shape[1] // parts)  # the range of so many, at most
    moves, late = np.ptp(levels, axis=1), np.ptp(levels[:, -3:], axis=1)
    for axis in np.flatnonzero(moves > np.maximum(recording.quality.drift_mdps * MDPS, chance)):
        settled = late[axis] < max(0.15 * moves[axis], chance[axis] / 2)
        check, end = ("warm-up", "settled") if settled else ("drift", "not settled at the end")
        detail = f"axis {AXES[axis]} by {moves[axis] / MDPS:.3g} mdps, {end}"
        recording.add(check, KEPT, detail)
