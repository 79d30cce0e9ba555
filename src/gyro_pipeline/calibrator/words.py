"""What should be known about an answer, for programs and, as sentences, for people."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from statistics import NormalDist

import numpy as np

from gyro_pipeline.calibrator.rest import Alarm
from gyro_pipeline.calibrator.state import Array, Mask, Reason
from gyro_pipeline.calibrator.stretch import VERTICAL, Stretch
from gyro_pipeline.conventions import AXES, MDPS

CONSTANT = 4
"""Blocks in a row in which an axis holds one value, of a sensor that is dead."""

_FAR = 15.0  # factor on the noise that another unit makes, not another device
_WARMER_C = 1.0  # over a log, from which on it is said
_ENOUGH = 6  # blocks that tell a unit by their noise
_UNITS = {57.3: "rad/s", 1e3: "mdps", 3600.0: "deg/h", 6.0: "rpm"}


@dataclass
class Facts:
    """What was noticed of the samples, counted while they come in."""

    samples: int = 0
    not_finite: int = 0
    zero: int = 0
    gaps: int = 0
    gap_s: float = 0.0
    jumps: int = 0
    constant: Array = field(default_factory=lambda: np.zeros(3))  # blocks in a row
    dead: Mask = field(default_factory=lambda: np.zeros(3, bool))
    ended: list[tuple[float, Alarm]] = field(default_factory=list)  # stretches: when, and why

    def look(self, variances: Array) -> None:
        """Count blocks (block, 3) in which an axis holds one value."""
        for block in variances:
            self.constant = np.where(block == 0, self.constant + 1, 0)
            self.dead = self.dead | (self.constant >= CONSTANT)

    @property
    def unusable(self) -> tuple[Reason, ...]:
        """Why the data cannot be used at all."""
        reasons = [
            Reason("dead", f"{AXES[axis]} holds one value for {CONSTANT} blocks: a dead sensor, or "
                   "steps far above its noise; check the sensor and its resolution", AXES[axis])
            for axis in np.flatnonzero(self.dead)
        ]  # fmt: skip
        if self.samples and self.zero == self.samples:
            reasons.append(Reason("dead", "all samples are zero: a dead sensor; check its wiring"))
        elif self.samples and self.not_finite == self.samples:
            text = "no sample is a finite number; check the columns (--columns)"
            reasons.append(Reason("not_finite", text))
        return tuple(reasons)


def unit_reason(factor: float, name: str) -> Reason | None:
    """That the noise is so far off the known one that the unit must be wrong."""
    if 1 / _FAR < factor < _FAR or not np.isfinite(factor) or factor <= 0:
        return None
    ratio = max(factor, 1 / factor)
    near = min(_UNITS, key=lambda unit: abs(np.log(ratio / unit)))
    way = "above" if factor > 1 else "below"
    text = (
        f"the noise is {ratio:.3g} times {way} that of {name}: a wrong unit? {_UNITS[near]} differ "
    )
    text += f"by {near:g}; give --units, or another --type"
    return Reason("unit", text, None, factor, _FAR)


def reasons_of(facts: Facts, stretch: Stretch, target_dps: float | None) -> tuple[Reason, ...]:
    """All that should be known, the most important first."""
    return (
        *facts.unusable, *_of_rest(facts, stretch), *_of_unit(stretch), *_of_history(stretch),
        *_of_noise(stretch, target_dps), *_of_samples(facts), *_of_temperature(stretch),
        *_of_rotation(stretch),
    )  # fmt: skip


def _of_rest(facts: Facts, stretch: Stretch) -> Iterator[Reason]:
    for start in stretch.motions:
        yield Reason("cut", f"a motion at {start:.1f} s was cut", None, start)
    last = {alarm.code: (at, alarm) for at, alarm in facts.ended}
    for at, alarm in last.values():
        if alarm.code == "rotation":
            rate, sigma = alarm.value / MDPS, alarm.sigma / MDPS
            text = f"the accelerometer sees a rotation of {rate:.2g} mdps (σ {sigma:.2g}) about a "
            text += f"horizontal axis before {at:.1f} s: not at rest"
        elif alarm.code == "noise":
            if reason := unit_reason(alarm.value, stretch.kind.name):
                yield reason
                continue
            text = f"up to {at:.1f} s the rates scatter {alarm.value:.1f} times as much as "
            text += f"{stretch.kind.name} does at rest: not at rest, or another --type"
        elif alarm.code == "attitude":
            text = f"the device was turned before {at:.1f} s; the stretch that knows most counts"
        else:
            text = f"in motion up to {at:.1f} s; the stretch that knows most counts"
        yield Reason(alarm.code, text, None, at)


def _of_unit(stretch: Stretch) -> Iterator[Reason]:
    """Too little noise is no motion, and no alarm of the test of rest."""
    if stretch.blocks < _ENOUGH or not np.all(stretch.freedom > 0):
        return
    factors = stretch.log_noise()[0] / (np.sqrt(stretch.scale) * stretch.kind.noise.white)
    if reason := unit_reason(sorted(factors.tolist())[1], stretch.kind.name):
        yield reason


def _of_history(stretch: Stretch) -> Iterator[Reason]:
    if np.isfinite(stretch.taken.prior.narrow).any():
        yield from stretch.taken.prior.reasons
    for conflict in stretch.taken.conflicts:
        for axis in np.flatnonzero(conflict.axes):
            away, z = float(conflict.away[axis] / MDPS), abs(conflict.away / conflict.sigma)[axis]
            chance = max(2 * NormalDist().cdf(-float(z)), 1e-12)
            text = (
                f"the history is {abs(away):.1f} mdps away (1 in {1 / chance:,.0f}) and was dropped"
            )
            yield Reason("conflict", text, AXES[axis], away, float(z))


def _of_noise(stretch: Stretch, target_dps: float | None) -> Iterator[Reason]:
    noise, unknown = stretch.kind.noise, not np.any(stretch.kind.noise_freedom)
    if unknown:
        text = "the colour of the noise is not known, and σ holds for white noise; give --type"
        yield Reason("colour", text)
    floor = noise.floor_dps * np.sqrt(stretch.noise_scale())
    for axis in np.flatnonzero(floor > (target_dps or np.inf)):
        text = f"the target is below the floor of {floor[axis] / MDPS:.2g} mdps, which no longer "
        text += "average of this sensor goes below"
        yield Reason("floor", text, AXES[axis], float(floor[axis] / MDPS), target_dps / MDPS)  # type: ignore[operator]
    if noise.warm_up is not None and stretch.blocks:
        left, sigma = stretch.taken.filter.warm_up()
        for axis in np.flatnonzero(np.abs(left) > np.maximum(2 * sigma, MDPS)):
            text = (
                f"warming up, still {left[axis] / MDPS:+.1f} mdps; the bias is what it settles to"
            )
            yield Reason("warm_up", text, AXES[axis], float(left[axis] / MDPS))


def _of_samples(facts: Facts) -> Iterator[Reason]:
    if facts.not_finite and facts.not_finite < facts.samples:
        text = f"{facts.not_finite} of {facts.samples} samples are not finite and were left out"
        yield Reason("not_finite", text, None, facts.not_finite)
    if facts.zero and facts.zero < facts.samples:
        text = f"{facts.zero} of {facts.samples} samples are zero on all axes and were left out"
        yield Reason("zero", text, None, facts.zero)
    if facts.gaps:
        text = f"samples are missing at {facts.gaps} places, {facts.gap_s:.3g} s in all"
        yield Reason("gap", text, None, facts.gap_s)
    if facts.jumps:
        text = f"the clock jumped {facts.jumps} times; time goes on from there"
        yield Reason("clock", text, None, facts.jumps)


def _of_temperature(stretch: Stretch) -> Iterator[Reason]:
    count, (least, most) = stretch.taken.sums[8], stretch.taken.range_c
    if 0 < count < stretch.blocks:
        text = (
            f"the temperature is missing in {stretch.blocks - count:.0f} of {stretch.blocks} blocks"
        )
        yield Reason("temperature", text, None, float(stretch.blocks - count))
    if count and most - least > _WARMER_C:
        text = f"the temperature moved by {most - least:.1f} °C; the bias may have moved with it"
        yield Reason("temperature", text, None, float(most - least), _WARMER_C)


def _of_rotation(stretch: Stretch) -> Iterator[Reason]:
    """The bound of a rotation that nothing sees, about the vertical where there is gravity."""
    if not stretch.blocks:
        return
    up, usable = stretch.up, stretch.usable
    unseen = np.ones(3, bool) if up is None else np.abs(up) > VERTICAL
    which = "the vertical" if up is not None else "any axis"
    if not (usable & unseen).any():
        yield Reason(
            "rotation_bound", f"A steady rotation about {which} cannot be told from a bias."
        )
        return
    spread = stretch.taken.prior.narrow + stretch.own().start_variance
    bound = 1.96 * float(np.sqrt(spread[usable & unseen].max())) / MDPS
    text = f"A steady rotation about {which} below {bound:.2g} mdps cannot be told from a bias."
    yield Reason("rotation_bound", text, None, bound)
