"""The prior of the bias from the past calibrations of a device (docs/calibrator.md, The model).

Each calibration stores its evidence: the mean and the variance of its own data alone. On one axis

    evidence_i = level_i + slope (temperature_i - reference) + turn-on_i + Earth's rate_i + noise_i

with a level that walks by a variance of walk^2 a day, and by conflict_mdps^2 at a knock that was
noted, a turn-on bias of standard deviation tau and noise of the stored variance. The first level is
unknown, and the slope has the normal prior of the device type. The bias of the next calibration is
its conditional mean given the others (kriging), integrated over a grid of tau and walk, each point
weighted by its restricted likelihood times the log-normal prior of the type.

The Earth turns at 4.18 mdps, so the bias of a device at rest depends on attitude and heading. With
the up direction u in the axes of the device, latitude phi and an unknown heading, the Earth's rate
is 4.18 sin(phi) u plus, on axis i, a horizontal part of variance (4.18 cos phi)^2 (1 - u_i^2) / 2.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from gyro_pipeline.calibrator.device_types import DeviceType
from gyro_pipeline.calibrator.filter import Array
from gyro_pipeline.calibrator.reasons import Reason, reason
from gyro_pipeline.conventions import MDPS

STILL, MOVING, UNSURE = "still", "moving", "unsure"  # unsure: too few blocks to say
USED, DROPPED, NONE = "used", "dropped", "none"  # how the history was treated on an axis

EARTH_DPS = 4.178e-3  # the Earth's rate, 15.041 deg/h
_SAME_ATTITUDE_DEG = 5.0  # attitudes count as different where they differ by more
_DAY_S = 86400.0
_GRID = (11, 9)  # points of tau and of the walk, over 2.5 standard deviations on both sides
_MAX_CALIBRATIONS = 100  # the latest ones are used
_MIN_DPS = 1e-3 * MDPS
_LEFT_OUT = "but σ leaves this out; give the type temperature_spread_mdps_per_c, for all axes"
_MIN_UNKNOWN_C = 5.0  # the least distance of an unknown temperature from those of the history

Triple = tuple[float, float, float]
Fitted = dict[str, tuple[float, float]]  # level, tau, walk and slope of an axis, each with its σ


@dataclass(frozen=True)
class Calibration:
    """A stored calibration: its evidence, from its own data alone, and its circumstances."""

    mean_dps: Triple | None  # None: the device was not at rest
    variance_dps2: Triple | None  # of the mean
    time: float | None = None  # of the first sample, POSIX seconds
    since_power_on_s: float | None = None
    temperature_c: Triple | None = None  # mean, least, most
    gravity: Triple | None = None  # mean acceleration, g
    seconds: float = 0.0  # at rest
    rest: Literal["still", "moving", "unsure"] = "still"
    outcome: tuple[str, str, str] = (NONE, NONE, NONE)  # how the history was treated on each axis
    noise_mdps_rts: Triple | None = None  # N, estimated from these data
    noise_freedom: float = 0.0  # its degrees of freedom
    same_heading: bool = False  # declared, as a record: one that is not declared may be the same
    known_still: bool = False  # declared
    knocks: int = 0  # noted before it
    reached: bool = True  # whether the target, if any, was reached
    attempt: int = 1  # 2: the previous attempt was not at rest or did not reach its target
    reasons: tuple[str, ...] = ()
    hash: str = ""  # hash of the source
    source: str = ""
    version: str = ""
    event: Literal["calibration", "set"] = "calibration"  # set: typed in by a person
    schema: int = 1

    @property
    def mean(self) -> Array:
        """Mean of the data, (3,), deg/s."""
        return np.array(self.mean_dps or [np.nan] * 3, np.float64)

    @property
    def variance(self) -> Array:
        """Variance of the mean, (3,), (deg/s)^2."""
        return np.array(self.variance_dps2 or [np.nan] * 3, np.float64)

    @property
    def celsius(self) -> float | None:
        """Mean temperature, degrees Celsius."""
        return None if self.temperature_c is None else self.temperature_c[0]

    @property
    def up(self) -> Array | None:
        """Direction of the mean acceleration, a unit vector (3,)."""
        return None if self.gravity is None else unit(np.array(self.gravity))


@dataclass(frozen=True)
class Circumstances:
    """Conditions of a calibration that are known besides its samples."""

    time: float | None = None  # of the first sample, POSIX seconds
    since_power_on_s: float | None = None  # None: the warm-up amplitude is free
    same_heading: bool = False  # whether the heading is declared to be that of the history
    latitude_deg: float | None = None
    known_still: bool = False  # declared to be at rest: nothing is cut
    attempt: int = 1
    knocks: int = 0  # noted so far
    temperature_c: float | None = None
    up: Array | None = None


@dataclass(frozen=True)
class Prior:
    """The prior of the bias on each axis, (3,); NaN and infinite variance without a history."""

    mean: Array  # of the bias, deg/s
    narrow: Array  # variance where the history is right
    wide: Array  # variance where it is wrong
    slope: Array  # of the bias, deg/s per degree Celsius; the type's without a history
    slope_sigma: Array
    count: int = 0  # calibrations that make the level, on the axis with the most
    reasons: tuple[Reason, ...] = ()  # why it was widened
    fitted: tuple[Fitted, ...] = ()


def unit(vector: Array) -> Array:
    """The unit vector in the direction of a vector."""
    return np.asarray(vector / np.linalg.norm(vector))


def angle_deg(first: Array, second: Array) -> float:
    """Angle between two vectors, degrees."""
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(first, second)), first @ second)))


def prior_of(
    calibrations: Sequence[Calibration], device_type: DeviceType, now: Circumstances
) -> Prior:
    """The prior of a calibration under the given circumstances, from the earlier calibrations."""
    past = list(calibrations)[-_MAX_CALIBRATIONS:]
    if not past:
        unknown, infinite = np.full(3, np.nan), np.full(3, np.inf)
        spread = device_type.dps("temperature_spread_mdps_per_c")
        slope = device_type.dps("temperature_slope_mdps_per_c")
        return Prior(unknown, infinite, infinite, slope, spread)
    days, turn_on = _days(past, now), device_type.dps("turn_on_mdps")
    members = [level_members(past, axis, turn_on[axis]) for axis in range(3)]
    axes = [
        _axis_prior([past[i] for i in numbers], days[[*numbers, -1]], axis, device_type, now)
        for axis, numbers in enumerate(members)
    ]
    mean, variance, tau, fitted = zip(*axes, strict=True)
    slope, slope_sigma = np.array([parameters["slope"] for parameters in fitted]).T
    earth, earth_reasons = _earth_rate_variance(past, now, np.array(tau))
    slopes = device_type.dps("temperature_spread_mdps_per_c"), slope, slope_sigma
    temperature, temperature_reasons = _temperature_variance(past, now, *slopes)
    narrow = np.array(variance) + earth + temperature
    # A wrong history spreads at least three times as much as a right one.
    wide = np.maximum(device_type.dps("conflict_mdps") ** 2, 9 * narrow)
    knocked = [reason("knocked")] if now.knocks > past[-1].knocks else []
    count, reasons = max(map(len, members)), (*earth_reasons, *temperature_reasons, *knocked)
    return Prior(np.array(mean), narrow, wide, slope, slope_sigma, count, reasons, fitted)


def level_members(past: Sequence[Calibration], axis: int, turn_on: float) -> list[int]:
    """Numbers of the calibrations that make the level of an axis.

    A calibration that contradicted the history is left out, unless the next one that contradicts it
    agrees with the first: then these two start a new level.
    """
    members: list[int] = []
    outlier: int | None = None
    for number, calibration in enumerate(past):
        if calibration.outcome[axis] != DROPPED:
            members.append(number)
            outlier = None
        elif outlier is not None and _agree(past[outlier], calibration, axis, turn_on):
            members, outlier = [outlier, number], None
        else:
            outlier = number
    return members or [len(past) - 1]


def _days(past: Sequence[Calibration], now: Circumstances) -> Array:
    """Days at which the n calibrations and the present one begin, (n + 1,), in any order.

    An unknown one is a day after the one before it, but not later than a known one after it, so
    that its age is at least what is known. An unknown present is a day after the latest.
    """
    days = np.array([*(c.time for c in past), now.time], np.float64) / _DAY_S  # NaN for None
    if np.isnan(days).all():
        days[0] = 0.0
    number, known = np.arange(len(days)), np.flatnonzero(np.isfinite(days))
    before = known[np.maximum(np.searchsorted(known, number, "right") - 1, 0)]
    later = np.fmin.accumulate(days[::-1])[::-1]  # the earliest known one after it
    days = np.where(np.isnan(days), np.fmin(days[before] + number - before, later), days)
    if now.time is None:
        days[-1] = days[:-1].max() + 1
    return days


def _agree(first: Calibration, second: Calibration, axis: int, turn_on: float) -> bool:
    """Whether two calibrations differ by less than three standard deviations."""
    variance = first.variance[axis] + second.variance[axis] + 2 * turn_on**2
    return bool(abs(first.mean[axis] - second.mean[axis]) < 3 * np.sqrt(variance))


def _axis_prior(
    past: Sequence[Calibration], days: Array, axis: int, device_type: DeviceType, now: Circumstances
) -> tuple[float, float, float, Fitted]:
    """Mean and variance of the next bias without the Earth's rate, tau^2, and the parameters."""
    temperatures = np.array([*(c.celsius for c in past), now.temperature_c], np.float64)
    unknown = np.isnan(temperatures[:-1])
    measured = temperatures[:-1][~unknown] if not unknown.all() else np.zeros(1)
    warmth = np.nan_to_num(temperatures - measured.mean()) * (not unknown.all())
    type_slope = device_type.dps("temperature_slope_mdps_per_c")[axis]
    spread = device_type.dps("temperature_spread_mdps_per_c")[axis] ** 2
    tau, walk, logs = _grid(device_type, axis)
    knocks = np.array([*(c.knocks for c in past), now.knocks])
    of_level = _level_covariance(days, walk, knocks, device_type.dps("conflict_mdps")[axis])
    moving = of_level + spread * np.outer(warmth, warmth)
    variances = np.array([c.variance[axis] for c in past])
    if not unknown.all():
        apart = max(measured.var(), _MIN_UNKNOWN_C**2)
        variances = variances + unknown * (spread + type_slope**2) * apart
    variances = variances + tau[:, None] ** 2
    among = moving[:, :-1, :-1] + variances[:, :, None] * np.eye(len(past))
    slope = np.broadcast_to(spread * warmth[:-1], variances.shape)
    cross = np.stack([moving[:, :-1, -1], of_level[:, :-1, -1], slope], axis=-1)
    targets = [moving[:, -1, -1] + tau**2, of_level[:, -1, -1], np.full(len(tau), spread)]
    y = _at_present_attitude(past, axis, now) - type_slope * warmth[:-1]
    flat = np.array([1.0, 1.0, 0.0])  # bias and level move with the level, the slope does not
    deviance, mean, variance = _krige(among, cross, np.stack(targets, axis=-1), y, flat)
    logs = logs - deviance / 2
    weights = np.exp(logs - logs.max()) / np.exp(logs - logs.max()).sum()
    (bias, sigma), level, (extra, slope_sigma) = _moments(weights, mean, variance)
    grid = np.stack([tau, walk], axis=-1)
    fitted = dict(zip(("tau", "walk"), _moments(weights, grid, np.zeros_like(grid)), strict=True))
    fitted |= {"level": level, "slope": (float(type_slope + extra), slope_sigma)}
    return bias + type_slope * warmth[-1], sigma**2, float(weights @ tau**2), fitted


def _level_covariance(days: Array, walk: Array, knocks: Array, step: float) -> Array:
    """Covariance of the level at each of n times, (g, n, n), which walks and moves at knocks."""
    days, steps = days - days.min(), (knocks - knocks.min()) * step**2
    walked = walk[:, None, None] ** 2 * np.minimum(days[:, None], days)
    return np.asarray(walked + np.minimum(steps[:, None], steps))


def _at_present_attitude(past: Sequence[Calibration], axis: int, now: Circumstances) -> Array:
    """Evidence (n,), with the Earth's vertical rate moved to the present attitude if known."""
    means = np.array([c.mean[axis] for c in past])
    if now.latitude_deg is None or now.up is None:
        return means
    ups = np.array([now.up[axis] if c.up is None else c.up[axis] for c in past])
    return means + EARTH_DPS * np.sin(np.radians(now.latitude_deg)) * (now.up[axis] - ups)


def _grid(device_type: DeviceType, axis: int) -> tuple[Array, Array, Array]:
    """Grid points of tau and of the walk, (g,) each, and the logarithm of their prior."""
    z = [np.linspace(-2.5, 2.5, number) for number in _GRID]
    first, second = (grid.ravel() for grid in np.meshgrid(*z, indexing="ij"))
    tau = np.maximum(device_type.dps("turn_on_mdps")[axis], _MIN_DPS)
    walk = np.maximum(device_type.dps("walk_mdps_per_rtday")[axis], _MIN_DPS)
    logs = -(first**2 + second**2) / 2
    return tau * device_type.turn_on_factor**first, walk * device_type.walk_factor**second, logs


def _krige(
    among: Array, cross: Array, targets: Array, y: Array, flat: Array
) -> tuple[Array, Array, Array]:
    """Restricted deviance, conditional means and variances of k targets at each point of a grid.

    ``among`` (g, n, n) is the covariance of the evidence y (n,) about an unknown level, ``cross``
    (g, n, k) its covariance with the targets, ``targets`` (g, k) holds their variances, and
    ``flat`` (k,) says by how much each target moves with the level.
    """
    reference = y.mean()
    columns = np.stack([np.ones(len(y)), y - reference], axis=-1)
    columns = np.broadcast_to(columns, (len(among), *columns.shape))
    root = np.linalg.cholesky(among)
    white = np.linalg.solve(root, np.concatenate([columns, cross], axis=-1))
    ones, data, to_targets = white[:, :, 0], white[:, :, 1], white[:, :, 2:]
    information = np.sum(ones**2, axis=1)
    level = np.sum(ones * data, axis=1) / information
    residuals = data - level[:, None] * ones
    deviance = 2 * np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
    deviance = deviance + np.log(information) + np.sum(residuals**2, axis=1)
    missing = flat - np.einsum("gn,gnk->gk", ones, to_targets)
    mean = flat * (level[:, None] + reference) + np.einsum("gn,gnk->gk", residuals, to_targets)
    variance = targets - np.sum(to_targets**2, axis=1) + missing**2 / information[:, None]
    return deviance, mean, np.maximum(variance, 0)


def _moments(weights: Array, mean: Array, variance: Array) -> list[tuple[float, float]]:
    """Mean and standard deviation of k mixtures over the grid, from means and variances (g, k)."""
    means = weights @ mean
    variances = weights @ (variance + (mean - means) ** 2)
    return [(float(m), float(np.sqrt(v))) for m, v in zip(means, variances, strict=True)]


def _temperature_variance(
    past: Sequence[Calibration], now: Circumstances, spread: Array, slope: Array, sigma: Array
) -> tuple[Array, list[Reason]]:
    """Variance due to a temperature that is unknown now, or beyond the range of the history.

    Beyond it, the slope is as uncertain as the type's; the part of the fitted one counts already.
    """
    ranges = [c.temperature_c for c in past if c.temperature_c is not None]
    if not ranges:
        return np.zeros(3), []
    least, most = min(r[1] for r in ranges), max(r[2] for r in ranges)
    if (value := now.temperature_c) is None:
        key, distance = "temperature unknown", max(most - least, _MIN_UNKNOWN_C)
        added = spread**2 + slope**2
    else:
        key, distance = "temperature beyond", max(value - most, least - value, 0.0)
        added = np.maximum(spread**2 - sigma**2, 0)
    if not distance:
        return np.zeros(3), []
    how = "which counts less" if np.all(spread + added) else _LEFT_OUT
    return added * distance**2, [reason(key, value, distance, least=least, most=most, how=how)]


def _earth_rate_variance(
    past: Sequence[Calibration], now: Circumstances, tau_squared: Array
) -> tuple[Array, list[Reason]]:
    """Variance of the Earth's rate between the past headings and this one, (3,), (deg/s)^2.

    Between two unknown headings it is (4.18 cos phi)^2 on a horizontal axis and 0 on a vertical
    one. It is 0 where the heading is declared to repeat and the attitude is that of the history.
    Where past attitudes differ, tau already contains it. Past headings are not measured, and may
    have been the same, so that tau does not contain it: without a declaration, the sum counts.
    """
    ups, up, latitude = [c.up for c in past if c.up is not None], now.up, now.latitude_deg
    before = unit(np.sum(ups, axis=0)) if ups else None
    turned = 0.0 if before is None or up is None else angle_deg(up, before)
    if turned > _SAME_ATTITUDE_DEG:
        cause = reason("attitude history", turned, _SAME_ATTITUDE_DEG)
    elif now.same_heading:
        return np.zeros(3), []
    else:
        cause = reason("heading")
    horizontal = (EARTH_DPS * (1.0 if latitude is None else np.cos(np.radians(latitude)))) ** 2
    variance = np.full(3, horizontal)
    if before is not None and up is not None:
        variance = horizontal * (1 - (up**2 + before**2) / 2)
        if latitude is None:
            variance = variance + (EARTH_DPS * (up - before)) ** 2
    if before is not None and max(angle_deg(u, before) for u in ups) > _SAME_ATTITUDE_DEG:
        variance = np.maximum(variance - tau_squared, 0)
    return variance, [cause]


def noise_of(calibrations: Sequence[Calibration], device_type: DeviceType) -> tuple[Array, Array]:
    """N^2 relative to the type, (3,), and its degrees of freedom, from type and history."""
    freedom = np.full(3, device_type.noise_freedom)
    if np.isinf(device_type.noise_freedom):
        return np.ones(3), freedom
    total = freedom.copy()
    for past in calibrations:
        if past.noise_mdps_rts is not None:
            noise = np.array(past.noise_mdps_rts) * MDPS / device_type.noise.white
            total += past.noise_freedom * noise**2
            freedom += past.noise_freedom
    return np.where(freedom > 0, total / np.maximum(freedom, 1e-9), 1.0), freedom
