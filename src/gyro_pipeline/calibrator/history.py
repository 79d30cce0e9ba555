"""What a device's past calibrations say about its bias now (CALIBRATOR.md, section 3).

Each calibration stores its evidence, the mean and the variance of its own data alone. Of one axis

    evidence_i = level_i + slope (temperature_i - reference) + turn-on_i + Earth's rate_i + noise_i

with a level that walks by a variance of walk^2 a day, a turn-on bias of standard deviation tau and
noise of the stored variance. The first level is unknown, the slope has the type's normal prior.
The bias of the next calibration is the conditional mean given the others (kriging), integrated over
a grid of tau and walk, each point weighing as its restricted likelihood times the log-normal prior
of the type.

The Earth turns at 4.18 mdps, so a bias at rest is one of an attitude and a heading. With the up
direction u in the axes of the device, latitude phi and an unknown heading, the Earth's rate is
4.18 sin(phi) u and, on axis i, something horizontal of variance (4.18 cos phi)^2 (1 - u_i^2) / 2.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from gyro_pipeline.calibrator.device_types import DeviceType
from gyro_pipeline.calibrator.state import DROPPED, Array, Reason
from gyro_pipeline.conventions import MDPS

EARTH_DPS = 4.178e-3
"""The Earth's rate, 15.041 deg/h."""

SAME_ATTITUDE_DEG = 5.0
"""Attitudes that differ by more are different ones."""

_GRID = (11, 9)  # points of tau and of the walk, over 2.5 standard deviations to both sides
_MOST = 100  # calibrations that are looked at, the latest
_LEAST_DPS = 1e-3 * MDPS


@dataclass(frozen=True)
class Calibration:
    """Evidence of one calibration.

    Attributes:
        mean: (3,), deg/s, by its own data alone.
        variance: (3,), of that.
        day: When it was made, in days since any one time; None where that is not known.
        temperature_c: Mean; None where it was not measured.
        up: (3,), the direction of the mean acceleration, a unit vector; None where not measured.
        outcome: What became of the history on each axis.
        noise: N, (3,), deg/s * sqrt(s), as it was in these data.
        freedom: Degrees of freedom of that.
    """

    mean: Array
    variance: Array
    day: float | None = None
    temperature_c: float | None = None
    up: Array | None = None
    outcome: tuple[str, ...] = ("none",) * 3
    noise: Array | None = None
    freedom: float = 0.0


@dataclass(frozen=True)
class Circumstances:
    """What is known of a calibration besides its rates.

    Attributes:
        day: As of :class:`Calibration`.
        temperature_c: As of :class:`Calibration`.
        up: As of :class:`Calibration`.
        same_heading: Whether the heading is declared to be that of the history.
        latitude_deg: None where it is not known.
    """

    day: float | None = None
    temperature_c: float | None = None
    up: Array | None = None
    same_heading: bool = False
    latitude_deg: float | None = None


@dataclass(frozen=True)
class Prior:
    """What the history says, (3,) each; NaN and infinite where it says nothing.

    Attributes:
        mean: Of the bias, deg/s.
        narrow: Variance where the history is right, (deg/s)^2.
        wide: Variance where it is wrong.
        slope: Of the bias, deg/s a degree Celsius; the type's where there is no history.
        slope_sigma: Its standard deviation.
        count: Calibrations of the level.
        reasons: What widened it.
        fitted: By axis, what ``model.json`` shows: level, tau, walk and slope, each with its
            standard deviation.
    """

    mean: Array
    narrow: Array
    wide: Array
    slope: Array
    slope_sigma: Array
    count: tuple[int, ...] = (0, 0, 0)
    reasons: tuple[Reason, ...] = ()
    fitted: tuple[dict[str, tuple[float, float]], ...] = field(default=(), repr=False)


def prior_of(calibrations: Sequence[Calibration], kind: DeviceType, now: Circumstances) -> Prior:
    """The prior of a calibration under these circumstances, by those before it."""
    past = list(calibrations)[-_MOST:]
    if not past:
        none, infinite = np.full(3, np.nan), np.full(3, np.inf)
        return Prior(none, infinite, infinite, kind.slope, kind.slope_spread)
    days, members = _days(past, now), [level_members(past, i, kind.turn_on[i]) for i in range(3)]
    axes = [
        _axis_prior([past[i] for i in chosen], days[[*chosen, -1]], axis, kind, now)
        for axis, chosen in enumerate(members)
    ]
    mean, variance, tau, fitted = zip(*axes, strict=True)
    slope, slope_sigma = np.array([of_axis["slope"] for of_axis in fitted]).T
    heading, reasons = _earth(past, now)
    if _spread_deg(past) > SAME_ATTITUDE_DEG:  # then tau holds it already
        heading = np.maximum(heading - np.array(tau), 0)
    beyond, too_warm = _beyond(past, kind, now)
    narrow = np.array(variance) + heading + beyond
    wide = np.maximum(kind.wide**2, 9 * narrow)  # of three narrow standard deviations, at least
    count, said = tuple(map(len, members)), (*reasons, *too_warm)
    return Prior(np.array(mean), narrow, wide, slope, slope_sigma, count, said, fitted)


def level_members(past: Sequence[Calibration], axis: int, turn_on: float) -> list[int]:
    """Which calibrations an axis's level is made of, by their numbers.

    One that contradicted the history is left out; a second that agrees with it starts a new level.
    """
    members: list[int] = []
    odd: int | None = None
    for number, calibration in enumerate(past):
        if calibration.outcome[axis] != DROPPED:
            members.append(number)
            odd = None
        elif odd is not None and _agree(past[odd], calibration, axis, turn_on):
            members, odd = [odd, number], None
        else:
            odd = number
    return members or [len(past) - 1]


def _agree(one: Calibration, other: Calibration, axis: int, turn_on: float) -> bool:
    """Within three standard deviations of their difference."""
    variance = one.variance[axis] + other.variance[axis] + 2 * turn_on**2
    return bool(abs(one.mean[axis] - other.mean[axis]) < 3 * np.sqrt(variance))


def _days(past: Sequence[Calibration], now: Circumstances) -> Array:
    """Days from the first calibration to each and to now, (n + 1,); one where it is not known."""
    times = [*(c.day for c in past), now.day]
    gaps = [
        1.0 if before is None or after is None else abs(after - before)
        for before, after in zip(times[:-1], times[1:], strict=True)
    ]
    return np.concatenate([[0.0], np.cumsum(gaps)])


def _axis_prior(
    past: Sequence[Calibration], days: Array, axis: int, kind: DeviceType, now: Circumstances
) -> tuple[float, float, float, dict[str, tuple[float, float]]]:
    """Mean and variance of the next bias without the Earth, tau squared, and what was fitted."""
    warmth, spread = _warmth(past, now), kind.slope_spread[axis] ** 2
    tau, walk, logs = _grid(kind, axis)
    days = days - days[0]
    of_walk = walk[:, None, None] ** 2 * np.minimum(days[:, None], days)
    moving = of_walk + spread * np.outer(warmth, warmth)
    variances = _variances(past, axis, spread) + tau[:, None] ** 2
    among = moving[:, :-1, :-1] + variances[:, :, None] * np.eye(len(past))
    slope = np.broadcast_to(spread * warmth[:-1], variances.shape)
    cross = np.stack([moving[:, :-1, -1], of_walk[:, :-1, -1], slope], axis=-1)
    own = [moving[:, -1, -1] + tau**2, of_walk[:, -1, -1], np.full(len(tau), spread)]
    y = _levelled(past, axis, now) - kind.slope[axis] * warmth[:-1]
    flat = np.array([1.0, 1.0, 0.0])  # the bias and the level move with the level, the slope not
    deviance, mean, variance = _krige(among, cross, np.stack(own, axis=-1), y, flat)
    logs = logs - deviance / 2
    weights = np.exp(logs - logs.max()) / np.exp(logs - logs.max()).sum()
    (bias, sigma), level, (extra, slope_sigma) = _moments(weights, mean, variance)
    of_tau, of_walk_size = _moments(weights, np.stack([tau, walk], -1), np.zeros((len(tau), 2)))
    fitted = {"level": level, "tau": of_tau, "walk": of_walk_size}
    fitted["slope"] = (float(kind.slope[axis] + extra), slope_sigma)
    return bias + kind.slope[axis] * warmth[-1], sigma**2, float(weights @ tau**2), fitted


def _variances(past: Sequence[Calibration], axis: int, spread: float) -> Array:
    """Of the evidence, (n,); more where the temperature is not known, and in others it is."""
    known = [c.temperature_c for c in past if c.temperature_c is not None]
    unknown = spread * float(np.var(known)) if known else 0.0
    return np.array([c.variance[axis] + (c.temperature_c is None) * unknown for c in past])


def _levelled(past: Sequence[Calibration], axis: int, now: Circumstances) -> Array:
    """Evidence (n,) with the Earth's vertical rate as in the attitude of now, where it is known."""
    means = np.array([c.mean[axis] for c in past])
    if now.latitude_deg is None or now.up is None:
        return means
    ups = np.array([now.up[axis] if c.up is None else c.up[axis] for c in past])
    return means + EARTH_DPS * np.sin(np.radians(now.latitude_deg)) * (now.up[axis] - ups)


def _grid(kind: DeviceType, axis: int) -> tuple[Array, Array, Array]:
    """Points of tau and of the walk, (g,) each, and the logarithm of their prior."""
    z = [np.linspace(-2.5, 2.5, number) for number in _GRID]
    first, second = (grid.ravel() for grid in np.meshgrid(*z, indexing="ij"))
    tau = max(kind.turn_on[axis], _LEAST_DPS) * kind.turn_on_factor**first
    walk = max(kind.walk[axis], _LEAST_DPS) * kind.walk_factor**second
    return tau, walk, -(first**2 + second**2) / 2


def _krige(
    among: Array, cross: Array, own: Array, y: Array, flat: Array
) -> tuple[Array, Array, Array]:
    """Restricted deviance, conditional means and variances of k targets at each point of a grid.

    Args:
        among: (g, n, n), covariance of the evidence.
        cross: (g, n, k), of it with the targets.
        own: (g, k), variances of the targets.
        y: (n,), the evidence, about an unknown level.
        flat: (k,), by how much a target moves with the level.
    """
    reference = y.mean()
    columns = np.stack([np.ones(len(y)), y - reference], axis=-1)
    columns = np.broadcast_to(columns, (len(among), *columns.shape))
    root = np.linalg.cholesky(among)
    white = np.linalg.solve(root, np.concatenate([columns, cross], axis=-1))
    ones, data, to_targets = white[:, :, 0], white[:, :, 1], white[:, :, 2:]
    information = np.sum(ones**2, axis=1)
    level = np.sum(ones * data, axis=1) / information
    left = data - level[:, None] * ones
    deviance = 2 * np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
    deviance = deviance + np.log(information) + np.sum(left**2, axis=1)
    missing = flat - np.einsum("gn,gnk->gk", ones, to_targets)
    mean = flat * (level[:, None] + reference) + np.einsum("gn,gnk->gk", left, to_targets)
    variance = own - np.sum(to_targets**2, axis=1) + missing**2 / information[:, None]
    return deviance, mean, np.maximum(variance, 0)


def _moments(weights: Array, mean: Array, variance: Array) -> list[tuple[float, float]]:
    """Means and standard deviations of k mixtures over the grid, from (g, k) of each."""
    means = weights @ mean
    variances = weights @ (variance + (mean - means) ** 2)
    return [(float(m), float(np.sqrt(v))) for m, v in zip(means, variances, strict=True)]


def _warmth(past: Sequence[Calibration], now: Circumstances) -> Array:
    """Degrees above the mean of the history, (n + 1,), 0 where they are not known."""
    known = [c.temperature_c for c in past if c.temperature_c is not None]
    reference = np.mean(known) if known else 0.0
    values = [*(c.temperature_c for c in past), now.temperature_c]
    return np.array([0.0 if t is None or not known else t - reference for t in values])


def _beyond(
    past: Sequence[Calibration], kind: DeviceType, now: Circumstances
) -> tuple[Array, list[Reason]]:
    """Variance of a temperature that the history has not seen, or that is not known now."""
    seen = [c.temperature_c for c in past if c.temperature_c is not None]
    if not seen or not np.any(kind.slope_spread):
        return np.zeros(3), []
    if now.temperature_c is None:
        distance = max(seen) - min(seen)
        text = f"the temperature is not known, in the history it was {_range(seen)}"
    else:
        distance = max(now.temperature_c - max(seen), min(seen) - now.temperature_c, 0.0)
        text = f"{now.temperature_c:.1f} °C is beyond the {_range(seen)} of the history"
    if not distance:
        return np.zeros(3), []
    reason = Reason("temperature", f"{text}: it counts less", None, now.temperature_c, distance)
    return (kind.slope_spread * distance) ** 2, [reason]


def _range(seen: Sequence[float]) -> str:
    return f"{min(seen):.1f} to {max(seen):.1f} °C"


def _mean_up(past: Sequence[Calibration]) -> Array | None:
    ups = [c.up for c in past if c.up is not None]
    total = np.sum(ups, axis=0) if ups else np.zeros(3)
    length = np.linalg.norm(total)
    return np.asarray(total / length) if length > 0 else None


def _spread_deg(past: Sequence[Calibration]) -> float:
    """The largest angle between the attitude of a calibration and their mean, degrees."""
    mean = _mean_up(past)
    angles = [angle_deg(c.up, mean) for c in past if c.up is not None and mean is not None]
    return max(angles, default=0.0)


def angle_deg(one: Array, other: Array) -> float:
    """Angle between two directions, degrees."""
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(one, other)), one @ other)))


def _earth(past: Sequence[Calibration], now: Circumstances) -> tuple[Array, list[Reason]]:
    """Variance of the Earth's rate between the history's headings and this one, (3,), (deg/s)^2.

    Two unknown headings: (4.18 cos phi)^2 on a horizontal axis, 0 on a vertical one. Nothing where
    the heading is declared to repeat and no other attitude is seen.
    """
    before, latitude = _mean_up(past), now.latitude_deg
    known = before is not None and now.up is not None
    turned = angle_deg(now.up, before) if known else 0.0  # type: ignore[arg-type]
    cosine = 1.0 if latitude is None else np.cos(np.radians(latitude))
    reasons = []
    if turned > SAME_ATTITUDE_DEG:
        text = f"the attitude differs by {turned:.0f}° from that of the history: it counts less"
        reasons.append(Reason("attitude", text, None, turned, SAME_ATTITUDE_DEG))
    elif now.same_heading:
        return np.zeros(3), []
    else:
        text = "the heading is not declared to repeat, so the history holds less about horizontal "
        text += "axes; declare it with --same-heading, or mounted = true in device.toml"
        reasons.append(Reason("heading", text))
    if not known:
        return np.full(3, (EARTH_DPS * cosine) ** 2), reasons
    squares = (now.up**2 + before**2) / 2  # type: ignore[operator]
    variance = (EARTH_DPS * cosine) ** 2 * (1 - squares)
    if latitude is None:
        variance = variance + (EARTH_DPS * (now.up - before)) ** 2  # type: ignore[operator]
    return variance, reasons


def noise_of(calibrations: Sequence[Calibration], kind: DeviceType) -> tuple[Array, Array]:
    """N^2 over that of the type, (3,), and its degrees of freedom: the type's and the device's."""
    freedom = np.full(3, kind.noise_freedom)
    if np.isinf(kind.noise_freedom):
        return np.ones(3), freedom
    total = freedom.copy()
    for past in calibrations:
        if past.noise is not None and past.freedom > 0:
            total += past.freedom * (past.noise / kind.noise.white) ** 2
            freedom += past.freedom
    return np.where(freedom > 0, total / np.maximum(freedom, 1e-9), 1.0), freedom
