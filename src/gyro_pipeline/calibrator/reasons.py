"""Remarks on a result: codes for programs, sentences for people."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, SupportsIndex

import numpy as np

from gyro_pipeline.conventions import AXES, MDPS

if TYPE_CHECKING:
    from gyro_pipeline.calibrator.calibrator import State
    from gyro_pipeline.calibrator.stretch import Stretch

UNUSABLE_CODES = {"dead", "unit"}  # of data that cannot be used at all
VERTICAL = 0.9  # an axis with a larger cosine of its angle to the vertical counts as vertical
UNIT_FACTOR = 15.0  # on the noise; a larger one means a wrong unit, not another device
_WHITE = 4.0  # the noise of samples and of block means differs by a smaller factor at rest
_WARMING_C = 1.0  # a larger change of temperature over a log is reported
MIN_FREEDOM = 6  # degrees of freedom of the noise, to recognise a unit by it
_UNITS = {57.3: "rad/s", 1e3: "mdps", 3600.0: "deg/h", 6.0: "rpm"}

_SENTENCES = {  # by code, followed by a word where a code has several sentences
    "dead": "one value for 2 s: a dead sensor, or steps far above its noise; check the sensor and "
    "its resolution",
    "dead zero": "all samples are zero: a dead sensor; check its wiring",
    "dead not_finite": "no sample is a finite number; check the columns (--columns)",
    "unit": "the noise is {ratio:.3g} times {way} that of {name}: {motion}a wrong unit? {unit} "
    "differ by {near:g}; give --units, or another --type",
    "cut": "a motion at {value:.1f} s was cut",
    "motion": "in motion up to {value:.1f} s; the stretch that knows most counts",
    "attitude": "the device was turned before {value:.1f} s; the stretch that knows most counts",
    "noise": "up to {value:.1f} s the rates scatter {factor:.1f} times as much as those of {name} "
    "at rest: not at rest, or another --type or --units",
    "rotation": "the accelerometer sees a rotation of {rate:.2g} mdps (σ {sigma:.2g}) about a "
    "horizontal axis before {value:.1f} s: not at rest",
    "attitude history": "the attitude differs by {value:.0f}° from that of the history, which "
    "counts less",
    "heading": "the heading is not declared to repeat, so the history counts less on horizontal "
    "axes; declare it with --same-heading, or mounted = true in device.toml",
    "knocked": "a knock was noted after the last calibration of the history, which counts less",
    "temperature unknown": "the temperature is not known, unlike the {least:.1f} to {most:.1f} °C "
    "of the history, {how}",
    "temperature beyond": "{value:.1f} °C is beyond the {least:.1f} to {most:.1f} °C of the "
    "history, {how}",
    "temperature missing": "the temperature is missing in {value:.0f} of {limit} blocks",
    "temperature moved": "the temperature moved by {value:.1f} °C; the bias may have moved with it",
    "conflict": "the history is {away:.1f} mdps away (1 in {chance:,.0f}) and was dropped",
    "attempt": "attempt {value}: earlier ones were not at rest or did not reach their target",
    "colour": "the colour of the noise is not known, and σ holds for white noise; give --type",
    "floor": "the target is below {value:.3g} mdps, the floor of this sensor: within minutes its "
    "bias moves by about this much, though σ, which holds for this moment, may be smaller",
    "warm_up": "warming up, still {value:+.1f} mdps; the bias is what it settles to",
    "not_finite": "{value} of {limit} samples are not finite and were left out",
    "zero": "{value} of {limit} samples are zero on all axes and were left out",
    "gap": "samples are missing at {places} places, {value:.3g} s in all",
    "clock": "the clock jumped, or a gap has an unknown length, {value} times; time continues from "
    "there",
    "rotation_bound": "A steady rotation about {about} below {value:.2g} mdps cannot be told from "
    "a bias.",
    "rotation_bound none": "A steady rotation about {about} cannot be told from a bias.",
}


@dataclass(frozen=True)
class Reason:
    """A remark on a result."""

    code: str  # one word for programs, such as ``conflict``, ``motion`` or ``floor``
    sentence: str  # the same for people
    axis: str | None = None  # x, y or z; None where it is about all
    value: float | None = None  # in the unit of the sentence
    limit: float | None = None  # that the value was compared with


def reason(
    key: str, value: float | None = None, limit: float | None = None,
    axis: SupportsIndex | None = None, **words: Any,
) -> Reason:  # fmt: skip
    """A reason, with its sentence from the table."""
    sentence = _SENTENCES[key].format(value=value, limit=limit, **words)
    return Reason(
        key.partition(" ")[0], sentence, None if axis is None else AXES[axis], value, limit
    )


def unit_reason(factor: float, name: str, inside: float | None = None) -> Reason | None:
    """The reason ``unit`` where the noise is so far from that of the type that a unit is wrong.

    Block means that scatter may be a motion; then ``inside`` is the factor of the samples. A wrong
    unit raises both alike, and by about a known factor.
    """
    if not 0 < factor < np.inf or 1 / UNIT_FACTOR < factor < UNIT_FACTOR:
        return None
    ratio, way, motion = max(factor, 1 / factor), "below", ""
    if factor > 1:
        way, motion = "above", "not at rest, or "
    near = min(_UNITS, key=lambda unit: abs(np.log(ratio / unit)))
    if inside is not None:
        white, known = inside / _WHITE < factor < inside * _WHITE, near / 2 < ratio < near * 2
        if not (white and known):
            return None
    words: dict[str, Any] = {"ratio": ratio, "way": way, "name": name, "motion": motion}
    return reason("unit", factor, UNIT_FACTOR, **words, near=near, unit=_UNITS[near])


def reasons_of(state: "State") -> Iterator[Reason]:
    """All remarks on a result, the most important first."""
    counts, stretch = state.counts, state.stretch
    yield from (reason("dead", axis=axis) for axis in np.flatnonzero(state.dead))
    yield from state.ended.values()
    for code in ("zero", "not_finite"):
        if 0 < counts[code] < counts["samples"]:
            yield reason(code, counts[code], counts["samples"])
        elif counts[code]:
            yield reason(f"dead {code}")
    setup, (noise, freedom) = stretch.setup, stretch.log_noise()
    if noise is not None and freedom >= MIN_FREEDOM and setup.noise_known:
        factors = noise / (setup.noise_factor * setup.noise.white)  # also too little noise
        if wrong_unit := unit_reason(sorted(factors.tolist())[1], setup.device_type.type):
            yield wrong_unit
    if np.isfinite(stretch.prior.narrow).any():
        yield from stretch.prior.reasons
    yield from stretch.notes
    if setup.now.attempt > 1:
        yield reason("attempt", setup.now.attempt)
    yield from _noise_reasons(stretch)
    if counts["gaps"]:
        yield reason("gap", counts["gap_ms"] / 1e3, places=counts["gaps"])
    if counts["jumps"]:
        yield reason("clock", counts["jumps"])
    yield from _temperature_reasons(stretch)
    yield from _rotation_reasons(stretch)


def _noise_reasons(stretch: "Stretch") -> Iterator[Reason]:
    setup, floor = stretch.setup, stretch.floor_dps / MDPS
    if not setup.device_type.noise_freedom:
        yield reason("colour")
    for axis in np.flatnonzero((stretch.floor_dps > setup.target_dps) & ~stretch.reached):
        yield reason("floor", float(floor[axis]), setup.target_dps / MDPS, axis)
    if setup.noise.warm_up is not None and stretch.blocks:
        left, sigma = stretch.filter.warm_up()
        for axis in np.flatnonzero(np.abs(left) > np.maximum(2 * sigma, MDPS)):
            yield reason("warm_up", float(left[axis] / MDPS), axis=axis)


def _temperature_reasons(stretch: "Stretch") -> Iterator[Reason]:
    measured = stretch.temperature
    if 0 < measured.blocks < stretch.blocks:
        yield reason("temperature missing", stretch.blocks - measured.blocks, stretch.blocks)
    moved = measured.most - measured.least
    if moved > _WARMING_C:
        yield reason("temperature moved", moved, _WARMING_C)


def _rotation_reasons(stretch: "Stretch") -> Iterator[Reason]:
    """The bound on an undetectable rotation, about the vertical where gravity is measured."""
    if not stretch.blocks:
        return
    up = stretch.up
    about = "any axis" if up is None else "the vertical"
    axes = stretch.usable & (True if up is None else np.abs(up) > VERTICAL)
    spread = np.where(axes, stretch.prior.narrow + stretch.estimate.start_variance, 0.0)
    bound = 1.96 * float(np.sqrt(spread.max())) / MDPS
    if 0 < bound < np.inf:
        yield reason("rotation_bound", bound, about=about)
    else:
        yield reason("rotation_bound none", about=about)
