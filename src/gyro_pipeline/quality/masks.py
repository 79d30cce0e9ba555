"""Checks that mask rows without a measurement, and require enough of the others."""

from statistics import NormalDist

import numpy as np

from gyro_pipeline.conventions import AXES
from gyro_pipeline.logs import KEPT, REJECTED, REPAIRED
from gyro_pipeline.parameters import LEAST_BLOCKS
from gyro_pipeline.physics.bias import runs
from gyro_pipeline.quality.recording import Recording, median
from gyro_pipeline.quality.rest import Array, Mask


def cut_zero_rows(recording: Recording) -> None:
    """Cut rows of zeros at the ends, which loggers write before the first sample."""
    rows = runs(np.any(recording.rates, axis=0))
    zeros = np.ones_like(recording.masked)
    if rows.size:
        zeros[rows[0, 0] : rows[-1, 1]] = False
    recording.mask("zero rows", zeros, outcome=KEPT)


def mask_non_finite(recording: Recording, largest: float = 1e12) -> None:
    """Mask NaN, infinity, and garbage so large that its square may overflow."""
    rates = recording.rates
    if not (rates.size and -largest < rates.min() <= rates.max() < largest):  # NaN fails as well
        _mask_samples(recording, "non-finite values", ~(np.abs(rates) < largest))


def mask_stuck(recording: Recording, least_s: float = 0.1) -> None:
    """Mask runs of equal values of an axis that last ``least_s`` and are longer than by chance.

    If a sample equals the previous one with probability p, n samples contain a run of more than k
    with a probability of at most n p^k. p is estimated from the samples of the axis outside the
    longest run, so a coarse quantisation allows longer runs.
    """
    rates, stuck = recording.rates, np.zeros(recording.rates.shape, bool)
    least = max(round(least_s * recording.rate_hz), 2)
    repeats = rates[:, 1:] == rates[:, :-1]
    for axis in np.flatnonzero(repeats.sum(axis=1) + 1 >= least):
        lengths = np.diff(np.flatnonzero(np.concatenate([[True], ~repeats[axis], [True]])))
        others = lengths.sum() - lengths.max()
        p = (others - lengths.size + 2) / (others + 2)  # Laplace's estimate, never 0 or 1
        chance = np.ceil(np.log(recording.quality.false_alarm / rates.shape[1]) / np.log(p))
        stuck[axis] = np.repeat(lengths > max(least - 1, chance), lengths)
    _mask_samples(recording, "stuck values", stuck)


def mask_dropouts(recording: Recording) -> None:
    """Mask rows that are zero on all axes, if they are ten times as frequent as by chance.

    By chance, axes are zero independently, as often as in the other rows. The probability of at
    least c rows, where m are expected, is at most (e m / c)^c.
    """
    zeros = recording.used == 0
    rows = np.count_nonzero(zeros.all(axis=0))
    if rows:
        shares = (zeros.sum(axis=1) - rows + 1) / (zeros.shape[1] - rows + 1)
        chance = rows * np.log(10 * zeros.shape[1] * np.prod(shares) / rows)
        if chance < np.log(recording.quality.false_alarm):
            dropouts = ~(np.any(recording.rates, axis=0) | recording.masked)
            recording.mask("dropouts", dropouts, "zero on all axes, ")


def _mask_samples(recording: Recording, check: str, samples: Mask) -> None:
    """Mask the rows with any of the given samples, (axis, n), that are not masked yet."""
    rows = samples.any(axis=0) & ~recording.masked
    axes = ", ".join(np.array(AXES)[samples[:, rows].any(axis=1)])
    recording.mask(check, rows, f"{'axes' if ',' in axes else 'axis'} {axes}, ")


def keep_longest_stretch(recording: Recording) -> None:
    """Keep the stretch between two gaps that has the most usable rows."""
    edges = np.unique([0, *recording.log.gap_rows, recording.masked.size])
    if edges.size > 2:  # noqa: PLR2004 - more than one stretch
        used = np.add.reduceat(~recording.masked, edges[:-1], dtype=np.intp)
        others = np.ones_like(recording.masked)
        others[slice(*edges[used.argmax() :][:2])] = False
        kept = recording.where(~others)
        detail = f"kept are {kept}, the longest of {len(used)} stretches without a gap"
        recording.add("gaps", REPAIRED, detail)
        recording.leave_out(others)
    recording.trim()


def require_length(recording: Recording) -> None:
    """Reject a recording if too few rows, or too small a share of them, are usable."""
    q, rate_hz, rows = recording.quality, recording.rate_hz, recording.masked.size
    used = rows - np.count_nonzero(recording.masked)
    least = max(q.least_s * rate_hz, LEAST_BLOCKS * recording.size)
    few_blocks = np.count_nonzero(recording.occupied) < LEAST_BLOCKS
    if few_blocks or used < max(least, q.least_share * rows):
        detail = (
            f"{used} of {len(recording.log.samples)} rows can be used, {used / rate_hz:.4g} s; "
            f"expected at least {least / rate_hz:.4g} s (quality.least_s) and {q.least_share:.0%} "
            "of the rows between two gaps (quality.least_share)"
        )
        recording.add("too short", REJECTED, detail)


def mask_bursts(recording: Recording, few: int = 3) -> None:
    """Mask spikes of fewer than ``few`` rows, and shocks with a block on each side for ringing.

    A shock in the first rows is a start. Anything longer than a shock is a motion.
    """
    size, level = recording.size, median(recording.blocks.means)[:, None]
    kinds = {kind: np.zeros_like(recording.masked) for kind in ("motion", "start", "shocks")}
    spikes, bursts = np.zeros((2, recording.masked.size), bool)
    for first, last in runs(exceeds_noise(recording)):
        if last - first < few:
            spikes[first:last] = True
        else:
            bursts[max(first - size, 0) : last + size] = True
    longest = recording.quality.shock_s * recording.rate_hz + 2 * size
    for first, last in runs(bursts):
        kind = "motion" if last - first >= longest else "shocks" if first else "start"
        kinds[kind][first:last] = True
    for check, bursts_of_kind in (kinds | {"spikes": spikes}).items():
        rows = bursts_of_kind & ~recording.masked
        if rows.any() and not recording.rejected:
            peaks = np.abs(recording.rates[:, rows] - level).max(axis=1)
            detail = f"up to {peaks.max():.3g} deg/s from the level, axis {AXES[peaks.argmax()]}, "
            if check == "motion":
                recording.add(check, REJECTED, f"{detail}{recording.where(rows)} (quality.shock_s)")
            else:
                recording.mask(check, rows, detail)


def exceeds_noise(recording: Recording) -> Mask:
    """Mask of rows that deviate from the local level by more than noise, and of such blocks.

    In white noise, any such row occurs with probability ``false_alarm``, for any number of rows.
    """
    rates, (starts, means, _, sigma, noise) = recording.filled, recording.blocks
    edges = np.append(0, starts[1:])
    lengths = np.diff(edges, append=rates.shape[1])
    deviations = rates - local_levels(means).repeat(lengths, axis=1)
    normal = -NormalDist().inv_cdf(recording.quality.false_alarm / (2 * rates.size))
    limits = normal * np.sqrt(1 + np.pi / (18 * recording.size)) * sigma
    rows = (np.abs(deviations) > limits[:, None]).any(axis=0)
    excluded = rows | recording.masked
    deviations[:, np.flatnonzero(excluded)] = 0
    counts = np.maximum(lengths - np.add.reduceat(excluded, edges, dtype=np.intp), 1)
    shifts = np.abs(np.add.reduceat(deviations, edges, axis=1) / counts)
    blocks = shifts > recording.quality.least_change_dps + 6 * noise[:, None]
    return rows | blocks.any(axis=0).repeat(lengths)


def local_levels(means: Array) -> Array:
    """Running medians of nine block means, (axis, block), which a movement hardly affects."""
    # a slope is continued beyond the ends, robustly against two outliers among the last blocks
    before = 2 * median(means[:, :5])[:, None] - means[:, 8:4:-1]
    after = 2 * median(means[:, -5:])[:, None] - means[:, -6:-10:-1]
    padded = np.hstack([before, means, after])
    windows = [padded[:, first : first + means.shape[1]] for first in range(9)]
    return np.partition(windows, 4, axis=0)[4]
