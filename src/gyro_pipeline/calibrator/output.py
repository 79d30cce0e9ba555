"""Results as text for people, as JSON for programs, and as a plot of the running estimate."""

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click
import numpy as np

from gyro_pipeline.calibrator.calibrator import State
from gyro_pipeline.calibrator.filter import Array
from gyro_pipeline.calibrator.history import DROPPED, NONE, STILL, USED
from gyro_pipeline.calibrator.reasons import Reason
from gyro_pipeline.calibrator.registry import SET, Device
from gyro_pipeline.conventions import AXES, MDPS, InputError

_HEADING_DEG = 3.6  # drift of the heading in an hour for 1 mdps
_IN_TEXT = {"conflict", "cut", "floor", "rotation_bound"}  # reasons that the text contains


def as_json(state: State, device: str | None, **more: Any) -> dict[str, Any]:
    """A result as a JSON object; null stands where there is no number."""
    return {
        "device": device,
        "bias_dps": numbers(state.bias_dps),
        "sigma_dps": numbers(state.sigma_dps),
        "rest": state.rest,
        "seconds_at_rest": state.seconds_at_rest,
        "seconds_left": numbers(state.seconds_left),
        "history": list(state.history),
        "reasons": [vars(reason) for reason in state.reasons],
        **more,
    }


def refused(sentence: str, device: str | None, source: str) -> dict[str, Any]:
    """A refusal as an object with the keys of a result."""
    result = dict.fromkeys(("bias_dps", "sigma_dps", "seconds_left"), [None] * len(AXES))
    rest = {"rest": None, "seconds_at_rest": 0.0, "history": [NONE] * len(AXES), "source": source}
    return {"device": device, **result, **rest, "reasons": [vars(Reason("refused", sentence))]}


def numbers(values: Array) -> list[float | None]:
    """Numbers for JSON, None where they are not finite."""
    return [value if math.isfinite(value) else None for value in values.tolist()]


def as_text(state: State) -> Iterator[str]:
    """A coloured table of the axes, with a summary above and the time left below."""
    yield click.style(_summary(state), fg="green" if state.rest == STILL else "red")
    sigmas = state.sigma_dps / MDPS
    if state.rest != STILL:
        if np.isinf(sigmas).all():
            return
        stored = "The stored value is still the one to use:"
        yield "Too short to tell rest from motion; so far:" if state.stretch.blocks else stored
    yield f"{'bias, deg/s':>17}{'σ, mdps':>11}   from"
    for axis, name in enumerate(AXES):
        row = f"{name}{state.bias_dps[axis]:+16.6f}{sigmas[axis]:11.2f}   {_sources(state, axis)}"
        yield click.style(row, fg="yellow") if state.history[axis] == DROPPED else row
    if np.isfinite(target_mdps(state)):
        yield _time_left(state)
    if np.isfinite(sigmas).all():
        drifts = zip(sigmas * _HEADING_DEG, AXES, strict=True)
        listed = ", ".join(f"{drift:.2g}° about {name}" for drift, name in drifts)
        yield f"In one hour the heading drifts by {listed} (1 σ of the bias alone)."
    yield from (r.sentence for r in state.reasons if r.code == "rotation_bound")


def target_mdps(state: State) -> float:
    """The target of a calibration; infinite without one."""
    return state.stretch.setup.target_dps / MDPS


def _summary(state: State) -> str:
    cut = ", ".join(f"{r.value:.1f} s" for r in state.reasons if r.code == "cut")
    text = "" if state.rest == STILL else f"not at rest ({state.rest}): "
    text += f"at rest for {state.seconds_at_rest:.1f} of {state.time_s:.1f} s"
    text += f" (a motion at {cut} was cut)" if cut else ""
    stretch, count = state.stretch, state.stretch.prior.count
    text += f"; {stretch.temperature.mean:.1f} °C" if stretch.temperature.blocks else ""
    if not count:
        return f"{text}; history: none"
    past = f"{count} calibration{'s' * (count != 1)}"
    past = "set by hand" if stretch.setup.history[0].event == SET else past
    heading = "" if stretch.setup.now.same_heading else "not "
    return f"{text}; history: {past}, heading {heading}declared to repeat"


def notes(state: State) -> Iterator[str]:
    """Remarks that the text does not contain."""
    for reason in state.reasons:
        if reason.code not in _IN_TEXT:
            yield f"{reason.axis}: {reason.sentence}" if reason.axis else reason.sentence


def _sources(state: State, axis: int) -> str:
    """The sources of the bias of an axis: this log, the history, or both."""
    if state.history[axis] == USED:
        stretch = state.stretch
        variances = stretch.estimate.variance[axis], stretch.prior.narrow[axis]
        log, history = np.sqrt(variances) / MDPS
        return f"this log {log:.2f}, history {history:.2f}"
    for reason in state.reasons:
        if (reason.code, reason.axis) == ("conflict", AXES[axis]):
            return f"this log alone: {reason.sentence}"
    return "this log"


def _time_left(state: State) -> str:
    floors = [r for r in state.reasons if r.code == "floor"]
    why = {floor.axis: f", below its floor of {floor.value:.3g}" for floor in floors}
    target, parts = f"{target_mdps(state):g} mdps", []
    for name, seconds in zip(AXES, state.seconds_left, strict=True):
        if np.isinf(seconds):
            parts.append(f"{name} does not reach {target}{why.get(name, ' within an hour')}")
        elif seconds:
            parts.append(f"{name} needs {math.ceil(seconds)} s more at rest for {target}")
    return f"{'; '.join(parts)}." if parts else f"The target of {target} is reached."


def planned(state: State) -> Iterator[str]:
    """A line for each axis: the seconds that a target takes, or why it cannot be reached."""
    target = target_mdps(state)
    text = f"{target:.3g} mdps ({target * _HEADING_DEG:.3g}° of heading an hour)"
    floors = state.stretch.floor_dps / MDPS
    for name, needed, floor in zip(AXES, state.seconds_left, floors, strict=True):
        if np.isfinite(needed):
            yield f"{name}: {needed:.1f} s at rest for {text}"
        elif floor > target:
            yield f"{name}: not with this sensor: its floor is {floor:.3g} mdps"
        else:
            yield f"{name}: not within an hour"


def device_list(rows: Sequence[Mapping[str, Any]], types: Sequence[str]) -> Iterator[str]:
    """A line for each device, and the names of the types."""
    for row in rows:
        yield f"{row['device']:<24} {row['type'] or '-':<12} {row['calibrations']:>4}"
    yield f"types: {', '.join(types)}"


def device_table(device: Device) -> Iterator[str]:
    """The history of a device, its fitted model, and how often it was not at rest."""
    yield (
        f"{'time, UTC':<17}{'source':<24}{'rest':>7}{'s':>7}{'°C':>6}  {'bias, deg/s':^36}"
        f"{'σ, mdps':^20}  history"
    )
    stored, counting = device.calibrations(), device.history()
    for line in device.lines():
        if line["event"] == "note":
            what = "note of a knock" if line.get("knocked") else "note"
            yield f"{_date(line):<17}{what}: {line['text']}"
        elif line["event"] != "forget":
            celsius = (line.get("temperature_c") or [math.nan])[0]
            celsius = "-" if math.isnan(celsius) else f"{celsius:.1f}"
            head = f"{_date(line):<17}{line['source'][:23]:<24}{line['rest']:>7}"
            head += f"{line['seconds']:7.1f}{celsius:>6}"
            mean = "".join(f"{m:+12.6f}" for m in line["mean_dps"] or [])
            sigma = "".join(f"{v**0.5 / MDPS:7.2f}" for v in line["variance_dps2"] or [])
            out = "" if stored.get(line["hash"]) in counting else "  (does not count)"
            yield f"{head}{mean}{sigma}  {'/'.join(line['outcome'])}{out}"
    model = device.model()
    for axis in sorted(model.keys() & set(AXES)):
        figures = (f"{key} {v:.3g} ± {sigma:.2g}" for key, (v, sigma) in model[axis].items())
        yield f"{axis}: {', '.join(figures)} (mdps, √s, √day, °C)"
    attempts = [c for c in stored.values() if c.event != SET]
    dropped = sum(DROPPED in c.outcome for c in attempts)
    failed = sum(c.rest != STILL for c in attempts)
    yield f"{len(attempts)} attempts: {failed} not at rest, {dropped} dropped the history"


def _date(line: Mapping[str, Any]) -> str:
    """The time of a line of a history, UTC."""
    seconds = line.get("time")
    if not isinstance(seconds, int | float):
        return "-"
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%d %H:%M}"


def check_plot(path: Path) -> None:
    """Check that a plot can be drawn and written; the suffix of the file sets its format.

    Raises:
        InputError: matplotlib is not installed, or the suffix or the folder cannot be used.
    """
    try:
        from matplotlib.backend_bases import FigureCanvasBase  # noqa: PLC0415 - the extra [plot]
    except ImportError as error:
        text = "--plot needs matplotlib: pip install 'gyro-pipeline[plot]'"
        raise InputError(text) from error
    suffixes = sorted(FigureCanvasBase.get_supported_filetypes())
    if path.suffix[1:].lower() not in suffixes:
        text = f"--plot: expected a file name that ends in .{', .'.join(suffixes)}, got {path}"
        raise InputError(text)
    if path.is_dir() or not os.access(path if path.exists() else path.parent, os.W_OK):
        raise InputError(f"--plot: expected a file that can be written, got {path}; give another")


def plot(path: Path, states: Sequence[State]) -> None:
    """Plot the running estimate with its limits, the history, the stop and motions that were cut.

    The last state is the final result.

    Raises:
        InputError: The file cannot be written.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415 - the extra [plot]

    figure = Figure(figsize=(8, 7), layout="constrained")
    panels = figure.subplots(3, 1, sharex=True)
    target = target_mdps(states[-1])
    stop = next((state.time_s for state in states if state.done), None)
    for axis, panel in enumerate(panels):
        _draw(panel, states, axis)
        if np.isfinite(target) and stop is not None:
            panel.axvline(stop, color="C2", linestyle="--", label=f"{target:g} mdps reached")
    panels[0].legend(loc="upper right", fontsize="small")
    panels[-1].set_xlabel("time, s")
    try:
        figure.savefig(path)
    except OSError as error:
        raise InputError(f"--plot {path}: not written: {error}; give another file") from error


def _draw(panel: Any, states: Sequence[State], axis: int) -> None:
    """Draw one axis, in mdps about its last estimate."""
    last, times = states[-1], [state.time_s for state in states]
    centre = last.bias_dps[axis]
    bias = np.array([state.bias_dps[axis] - centre for state in states]) / MDPS
    band = 1.96 * np.array([state.sigma_dps[axis] for state in states]) / MDPS
    panel.fill_between(times, bias - band, bias + band, alpha=0.25, label="95 %")
    panel.plot(times, bias, label="estimate")
    if last.history[axis] != NONE:
        prior = last.stretch.prior
        middle, half = prior.mean[axis] - centre, 1.96 * np.sqrt(prior.narrow[axis])
        low, high = (middle - half) / MDPS, (middle + half) / MDPS
        panel.axhspan(low, high, color="C1", alpha=0.2, label="history, 95 %")
    for reason in last.reasons:
        if reason.code == "cut":
            panel.axvline(reason.value, color="C3", label="cut")
    usual = np.median(band[np.isfinite(band)]) if np.isfinite(band).any() else 1.0
    panel.set_ylim(-5 * usual, 5 * usual)
    panel.set_ylabel(f"{AXES[axis]}, mdps")
    panel.set_title(f"{AXES[axis]} about {centre:+.6f} deg/s", loc="left", fontsize="small")
