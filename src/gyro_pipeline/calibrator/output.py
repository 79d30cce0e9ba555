"""Answers as text for people and as JSON for programs, and a picture of how one came about."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gyro_pipeline.calibrator.state import DROPPED, USED, Array, State
from gyro_pipeline.conventions import AXES, MDPS

NOT_IN_TEXT = {"conflict", "rotation_bound", "floor"}
"""Reasons that the text says in another place."""

HEADING_DEG = 3.6
"""Degrees of heading an hour in one mdps."""


def as_json(state: State, device: str | None, **more: Any) -> dict[str, Any]:
    """One object for a program; null stands where there is no number."""
    return {
        "device": device,
        "bias_dps": _numbers(state.bias_dps),
        "sigma_dps": _numbers(state.sigma_dps),
        "rest": state.rest,
        "seconds_at_rest": state.seconds_at_rest,
        "seconds_left": _numbers(state.seconds_left),
        "history": list(state.history),
        "reasons": [
            {"code": r.code, "axis": r.axis, "value": _number(r.value), "limit": _number(r.limit), "text": r.sentence}
            for r in state.reasons
        ],
        **more,
    }  # fmt: skip


def _numbers(values: Array) -> list[float | None]:
    return [_number(value) for value in values.tolist()]


def _number(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)


def as_text(state: State, target_mdps: float | None, temperature_c: float | None, past: str) -> str:
    """A table of the axes, with a line above and what is left to do below."""
    warmth = "" if temperature_c is None else f"; {temperature_c:.1f} °C"
    cut = [f"{r.value:.1f} s" for r in state.reasons if r.code == "cut" and r.value is not None]
    knocks = f" (a motion at {', '.join(cut)} was cut)" if cut else ""
    at_rest = f"at rest for {state.seconds_at_rest:.1f} of {state.time_s:.1f} s"
    head = f"{at_rest if state.rest == 'still' else f'not at rest: {state.rest}, {at_rest}'}"
    lines = [f"{head}{knocks}{warmth}; history: {past}"]
    lines.append(f"{'bias, deg/s':>17}{'σ, mdps':>11}   from")
    for axis, name in enumerate(AXES):
        sigma = state.sigma_dps[axis] / MDPS
        lines.append(f"{name}{state.bias_dps[axis]:+16.6f}{sigma:11.2f}   {_from(state, axis)}")
    return "\n".join([*lines, *_left(state, target_mdps), *_drift(state), *_bound(state)])


def _from(state: State, axis: int) -> str:
    """What an axis's answer is made of."""
    alone = state.own_sigma_dps[axis] / MDPS
    if state.history[axis] == USED:
        return f"this log {alone:.2f}, history {state.history_sigma_dps[axis] / MDPS:.2f}"
    if state.history[axis] == DROPPED:
        why = (r.sentence for r in state.reasons if r.code == "conflict" and r.axis == AXES[axis])
        return f"this log alone: {next(why, 'the history was dropped')}"
    return "this log"


def _left(state: State, target_mdps: float | None) -> list[str]:
    """How long it still takes."""
    if target_mdps is None:
        return []
    parts = []
    floors = {r.axis: r.value for r in state.reasons if r.code == "floor"}
    for name, seconds in zip(AXES, state.seconds_left, strict=True):
        if np.isinf(seconds) and floors.get(name):
            parts.append(
                f"{name} does not reach {target_mdps:g} mdps: its floor is {floors[name]:.2g}"
            )
        elif np.isinf(seconds):
            parts.append(f"{name} does not reach {target_mdps:g} mdps within an hour")
        elif seconds:
            parts.append(
                f"{name} needs {math.ceil(seconds):d} s more at rest for {target_mdps:g} mdps"
            )
    return (
        [f"{'; '.join(parts)}."] if parts else [f"The target of {target_mdps:g} mdps is reached."]
    )


def _drift(state: State) -> list[str]:
    """What the standard deviations mean for a heading."""
    if not np.isfinite(state.sigma_dps).all():
        return []
    drifts = [
        f"{s / MDPS * HEADING_DEG:.2g}° about {n}"
        for s, n in zip(state.sigma_dps, AXES, strict=True)
    ]
    return [f"In one hour the heading drifts by {', '.join(drifts)} (1 σ of the bias alone)."]


def _bound(state: State) -> list[str]:
    return [r.sentence for r in state.reasons if r.code == "rotation_bound"]


def plot(path: Path, states: Sequence[State], target_mdps: float | None) -> None:
    """A picture of the running estimate with its band, the history, the stop and what was cut.

    Args:
        path: Of the picture; its ending says of which kind.
        states: One a second or so, the last one finished.
        target_mdps: To mark the stop.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415 - the extra [plot]

    figure = Figure(figsize=(8, 7), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True)
    last, times = states[-1], np.array([state.time_s for state in states])
    for axis, (name, ax) in enumerate(zip(AXES, axes, strict=True)):
        centre = last.bias_dps[axis]
        bias = np.array([state.bias_dps[axis] - centre for state in states]) / MDPS
        band = 1.96 * np.array([state.sigma_dps[axis] for state in states]) / MDPS
        ax.fill_between(times, bias - band, bias + band, alpha=0.25, label="95 %")
        ax.plot(times, bias, label="estimate")
        if last.history[axis] != "none":
            past, width = (
                (last.history_dps[axis] - centre) / MDPS,
                last.history_sigma_dps[axis] / MDPS,
            )
            ax.axhspan(
                past - 1.96 * width,
                past + 1.96 * width,
                color="C1",
                alpha=0.2,
                label="history, 95 %",
            )
        for reason in last.reasons:
            if reason.code == "cut" and reason.value is not None:
                ax.axvline(reason.value, color="C3", label="cut")
        stop = next((state.time_s for state in states if state.done), None)
        if target_mdps and stop is not None:
            ax.axvline(stop, color="C2", linestyle="--", label=f"{target_mdps:g} mdps reached")
        usual = np.median(band[np.isfinite(band)]) if np.isfinite(band).any() else 1.0
        ax.set_ylim(-5 * usual, 5 * usual)
        ax.set_ylabel(f"{name}, mdps about {centre:+.5f} deg/s")
    axes[0].legend(loc="upper right", fontsize="small")
    axes[-1].set_xlabel("time, s")
    figure.savefig(path)
