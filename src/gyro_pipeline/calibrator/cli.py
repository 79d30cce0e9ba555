"""``gyro-calibrate``: what a person types. Results go to standard output, words to standard error.

Exit codes, the highest of several files: 0 done; 2 usage; 3 target not reached; 4 not at rest;
5 no usable history where --require-history asks for it; 6 data that cannot be used; 7 nothing can
be stored.
"""

import hashlib
import json
import re
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import click
import numpy as np

from gyro_pipeline import __version__
from gyro_pipeline.calibrator import output
from gyro_pipeline.calibrator.calibrator import BLOCK_S, Calibrator
from gyro_pipeline.calibrator.device_types import names
from gyro_pipeline.calibrator.history import describe
from gyro_pipeline.calibrator.registry import (
    Device,
    RegistryError,
    line_of,
    opened,
    registry_folder,
)
from gyro_pipeline.calibrator.registry import (
    devices as all_devices,
)
from gyro_pipeline.calibrator.state import DROPPED, STILL, USED, State
from gyro_pipeline.conventions import AXES, MDPS, InputError

DONE, USAGE, NOT_REACHED, NOT_AT_REST, NO_HISTORY, UNUSABLE, NOT_STORED = 0, 2, 3, 4, 5, 6, 7

_SHORT = {"scale_dps": "scale"}


@dataclass
class Settings:
    """The options that ``log`` and ``stream`` share."""

    device: str | None
    device_type: str | None
    registry: str | None
    target: float | None
    same_heading: bool | None
    latitude: float | None
    started_at: str | None
    since_power_on: float | None
    known_still: bool
    require_history: bool
    store: bool
    json: bool
    plot: str | None
    rate: float | None
    reader: dict[str, Any]


def _reader_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """An option for each of the readers', under its name."""
    from gyro_pipeline.parameters import ReaderOptions  # noqa: PLC0415

    for name, field in reversed(ReaderOptions.model_fields.items()):
        flag = "--" + _SHORT.get(name, name).replace("_", "-")
        text = field.description or {"rate_tolerance_pct": "that rates may differ"}.get(name, "")
        if name in {"time_column"}:
            text = "a name, or a number from 0"
        command = click.option(
            flag, name, help=f"{text}", metavar="VALUE", hidden=name == "rate_tolerance_pct"
        )(command)
    return command


def _shared_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Options of ``log`` and ``stream``."""
    options = [
        click.option("--device", help="name in the registry; its history is used and added to"),
        click.option("--type", "device_type", help="of the device; see devices/types"),
        click.option("--registry", type=click.Path(), help="folder of the devices"),
        click.option("--target", type=float, help="standard deviation that is wanted, mdps"),
        click.option("--same-heading/--any-heading", default=None, help="the heading repeats"),
        click.option("--latitude", type=float, help="degrees"),
        click.option("--started-at", help="time of the first sample, ISO 8601 or POSIX seconds"),
        click.option("--since-power-on", type=float, help="seconds, at the first sample"),
        click.option("--known-still", is_flag=True, help="it was at rest: cut nothing"),
        click.option("--require-history", is_flag=True, help="exit 5 where none is used"),
        click.option("--store/--no-store", default=True, help="add to the device's history"),
        click.option("--json", "json", is_flag=True, help="one JSON object"),
        click.option("--plot", type=click.Path(), help="write a picture"),
        click.option("--rate", type=float, help="samples a second, where times do not tell"),
    ]
    for option in reversed(options):
        command = option(command)
    return command


def _settings(values: dict[str, Any]) -> Settings:
    """Split the values into the shared options and the readers'."""
    shared = {key: values.pop(key) for key in Settings.__annotations__ if key != "reader"}
    given = {key: _typed(key, value) for key, value in values.items() if value is not None}
    return Settings(**shared, reader=given)


def _typed(name: str, text: str) -> Any:
    """An option's text as the readers take it."""
    if name in {"columns", "acceleration_columns"}:
        return tuple(_column(part) for part in text.split(","))
    if name.endswith("_column"):
        return _column(text)
    if name == "rows":
        pairs = (part.partition("=") for part in text.split(","))
        return {_column(key): value if output is None else _maybe(value) for key, _, value in pairs}
    return text


def _column(text: str) -> str | int:
    return int(text) if text.strip().isdigit() else text.strip()


def _maybe(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def _options(reader: dict[str, Any]) -> Any:
    """The readers' options, checked.

    Raises:
        InputError: One is not as it should be.
    """
    from pydantic import ValidationError  # noqa: PLC0415

    from gyro_pipeline.parameters import ReaderOptions  # noqa: PLC0415

    try:
        return ReaderOptions(**reader)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"][:1]))
        text = first["msg"].removeprefix("Value error, ")
        raise InputError(f"--{_flag(where)}: {text}" if where else text) from error


def _flag(name: str) -> str:
    return _SHORT.get(name, name).replace("_", "-")


def _in_options(message: str) -> str:
    """A reader's message with options of the command line in place of keys of a catalog."""
    from gyro_pipeline.parameters import ReaderOptions  # noqa: PLC0415
    from gyro_pipeline.readers.table import IN_READER  # noqa: PLC0415

    if IN_READER not in message:
        return message
    said, _, advice = message.replace(f" {IN_READER}", "").rpartition("; ")
    for name in sorted(ReaderOptions.model_fields, key=len, reverse=True):
        advice = re.sub(rf"(?<![\w-])`?{name}\b(?!-):?`?", f"--{_flag(name)}", advice)
    return f"{said}; {advice}"


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__)
def main() -> None:
    """Calibrate a gyroscope at rest: its bias, a standard deviation, and the seconds still needed."""


@main.command()
@click.argument("files", nargs=-1, required=True, type=click.Path(exists=True, dir_okay=False))
@_shared_options
@_reader_options
def log(files: tuple[str, ...], **values: Any) -> None:
    """Calibrate from each of some files."""
    settings = _settings(values)
    sys.exit(max(_guarded(lambda: _log(Path(name), settings)) for name in files))


def _guarded(work: Callable[[], int]) -> int:
    """An exit code; what cannot be used or stored is said in one sentence."""
    try:
        return work()
    except InputError as error:
        click.secho(_in_options(str(error)), fg="red", err=True)
        return UNUSABLE
    except RegistryError as error:
        click.secho(str(error), fg="red", err=True)
        return NOT_STORED


def _log(path: Path, settings: Settings) -> int:
    """One file."""
    from gyro_pipeline.logs import REJECTED  # noqa: PLC0415
    from gyro_pipeline.readers import read_log  # noqa: PLC0415

    source = hashlib.sha256(path.read_bytes()).hexdigest()
    device = _device(settings)
    recording = read_log(path, _options(settings.reader), settings.rate)
    for finding in recording.findings:
        if finding.outcome == REJECTED:
            raise InputError(f"{path}: {finding.check}: {finding.detail}")
    rate_hz = recording.rate_hz or settings.rate
    if rate_hz is None:
        raise InputError(
            f"{path}: expected times in the file, or the rate, got neither; give --rate"
        )
    calibrator = _calibrator(settings, rate_hz, source)
    count = len(recording.samples)
    times = np.arange(count) / rate_hz
    for row in recording.gap_rows:  # how long a gap is, a log does not say
        times[row:] += 2 * BLOCK_S
    step = round(rate_hz) if settings.plot else max(count, 1)
    states = []
    for first in range(0, count, step):
        part = slice(first, first + step)
        accel, warmth = recording.acceleration_g, recording.temperature_c
        states.append(
            calibrator.update(
                times[part], recording.samples[part], None if accel is None else accel[part],
                None if warmth is None else warmth[part],
            )
        )  # fmt: skip
    notes = [
        finding.detail for finding in recording.findings if finding.check == "unreadable cells"
    ]
    return _report(calibrator, settings, states, device, source, str(path), notes)


def _device(settings: Settings) -> Device | None:
    """The device's folder, which can be written, where something is to be stored."""
    if settings.device is None:
        return None
    device = Device(registry_folder(settings.registry), settings.device)
    if settings.store:
        device.check_writable()
        device.create(settings.device_type)
    return device


def _calibrator(settings: Settings, rate_hz: float, source: str | None) -> Calibrator:
    given = opened(
        settings.device, settings.registry, settings.device_type, settings.same_heading,
        settings.latitude, _posix(settings.started_at), source,
    )  # fmt: skip
    target = None if settings.target is None else settings.target * MDPS
    return Calibrator(
        given.kind, rate_hz, given.history, given.now, target, settings.since_power_on,
        settings.known_still,
    )  # fmt: skip


def _posix(text: str | None) -> float | None:
    if text is None:
        return None
    try:
        return float(text)
    except ValueError:
        pass
    try:
        return datetime.fromisoformat(text).timestamp()
    except ValueError as error:
        raise InputError(
            f"--started-at: expected 2026-01-31T12:00:00+00:00 or POSIX seconds, got {text!r}"
        ) from error


def _report(
    calibrator: Calibrator, settings: Settings, states: Sequence[State], device: Device | None,
    source: str, name: str, notes: Sequence[str] = (),
) -> int:  # fmt: skip
    """Print, plot and store; returns the exit code."""
    state = calibrator.finish()
    code = _code(calibrator, state, settings)
    if settings.json:
        click.echo(json.dumps(output.as_json(state, settings.device, source=name), allow_nan=False))
    else:
        _print(calibrator, state, settings, name, code)
    for note in notes:
        click.secho(note, fg="yellow", err=True)
    if settings.plot:
        _plot(settings, [*states, state])
    if device is not None and settings.store and code != UNUSABLE:
        _store(calibrator, state, settings, device, source, name)
    return code


def _code(calibrator: Calibrator, state: State, settings: Settings) -> int:
    """The exit code of an answer."""
    if calibrator.facts.unusable or any(reason.code == "unit" for reason in state.reasons):
        return UNUSABLE
    codes = [DONE]
    if state.rest != STILL:
        codes.append(NOT_AT_REST)
    elif not state.reached:
        codes.append(NOT_REACHED)
    if settings.require_history and not all(outcome == USED for outcome in state.history):
        codes.append(NO_HISTORY)
    return max(codes)


def _print(
    calibrator: Calibrator, state: State, settings: Settings, name: str, code: int
) -> None:  # fmt: skip
    """The answer as text, and what should be known on standard error."""
    prior = calibrator.stretch.taken.prior
    past = describe(prior.count, calibrator.now.same_heading)
    if code != UNUSABLE:
        text = output.as_text(state, settings.target, calibrator.evidence().temperature_c, past)
        bold = not any(outcome == DROPPED for outcome in state.history)
        click.echo(text if not bold else text)
    for reason in state.reasons:
        if reason.code not in output.NOT_IN_TEXT and not (reason.code == "cut"):
            axis = f"{reason.axis}: " if reason.axis else ""
            colour = "red" if code in {UNUSABLE, NOT_AT_REST} else "yellow"
            click.secho(f"{axis}{reason.sentence}", fg=colour, err=True)
    if code == UNUSABLE:
        click.secho(f"{name}: these data cannot be used", fg="red", err=True)


def _plot(settings: Settings, states: Sequence[State]) -> None:
    try:
        output.plot(Path(str(settings.plot)), states, settings.target)
    except ImportError as error:
        text = "--plot needs matplotlib: pip install 'gyro-pipeline[plot]'"
        raise InputError(text) from error


def _store(  # noqa: PLR0917 - what a line is made of
    calibrator: Calibrator, state: State, settings: Settings, device: Device, source: str, name: str
) -> None:
    """Add the calibration, or the attempt, to the device's history."""
    evidence = calibrator.evidence()
    said = {
        "hash": source, "time": _posix(settings.started_at),
        "since_power_on_s": settings.since_power_on, "source": Path(name).name,
        "same_heading": calibrator.now.same_heading, "known_still": settings.known_still,
        "version": __version__,
    }  # fmt: skip
    line = line_of(evidence, state, said, calibrator.temperature_range())
    if not device.append(line):
        click.secho("this log is stored already; it is not stored again", err=True)
        return
    later = opened(device.name, settings.registry, settings.device_type, settings.same_heading)
    fitted = Calibrator(later.kind, calibrator.rate_hz, later.history, later.now)
    noise = (np.sqrt(fitted.scale) * later.kind.noise.white / MDPS).round(4)
    known = [float(n) if f > 0 else None for n, f in zip(noise, fitted.freedom, strict=True)]
    device.write_model(fitted.stretch.taken.prior, known)


@main.command()
@click.option("--port", help="serial port; else standard input")
@click.option("--baud", type=int, default=115200, show_default=True)
@click.option("--timeout", type=float, default=5.0, show_default=True, help="of silence, seconds")
@_shared_options
@_reader_options
def stream(port: str | None, baud: int, timeout: float, **values: Any) -> None:
    """Calibrate from lines as they come, until the target is reached: a JSON line a second."""
    settings = _settings(values)
    sys.exit(_guarded(lambda: _stream(port, baud, timeout, settings)))


def _stream(port: str | None, baud: int, timeout_s: float, settings: Settings) -> int:
    from gyro_pipeline.calibrator.stream import Parser, Silence, lines_of  # noqa: PLC0415

    device = _device(settings)
    parser = Parser(_options(settings.reader), settings.rate)
    calibrator: Calibrator | None = None
    states: list[State] = []
    digest, ended = hashlib.sha256(str(time.time_ns()).encode()), ""
    if settings.started_at is None:
        settings.started_at = str(time.time())
    lines = lines_of(_descriptor(port, baud), timeout_s)
    while not (states and states[-1].done and settings.target is not None):
        try:
            some = next(lines, None)
        except Silence:
            ended, some = f"nothing came for {timeout_s:g} s; this is what there is", None
        samples = parser.feed(some or [], ended=some is None)
        digest.update("\n".join(some or []).encode())
        if samples is not None:
            if calibrator is None:
                calibrator = _calibrator(settings, parser.rate_hz or 0.0, None)
            for part in _seconds(samples, calibrator.rate_hz):
                states.append(calibrator.update(*part))
                if not states[:-1] or int(states[-1].time_s) > int(states[-2].time_s):
                    click.echo(
                        json.dumps(output.as_json(states[-1], settings.device), allow_nan=False)
                    )
                if states[-1].done and settings.target is not None:
                    break
        if some is None:
            break
    if calibrator is None:
        raise InputError(
            f"standard input: expected lines of samples, got none{'; ' * bool(ended)}{ended}"
        )
    if ended:
        click.secho(ended, fg="yellow", err=True)
    if parser.bad:
        click.secho(
            f"{parser.bad} lines were of another shape and were left out", fg="yellow", err=True
        )
    return _report(
        calibrator, settings, states, device, digest.hexdigest(), port or "standard input"
    )


def _seconds(samples: Any, rate_hz: float) -> Any:
    """Samples a second at a time, as arguments of the calibrator."""
    step = max(round(rate_hz), 1)
    for first in range(0, len(samples.gyro_dps), step):
        columns = (samples.time_s, samples.gyro_dps, samples.accel_g, samples.temperature_c)
        yield [None if column is None else column[first : first + step] for column in columns]


def _descriptor(port: str | None, baud: int) -> int:
    """Of standard input, or of a serial port."""
    if port is None:
        return sys.stdin.fileno()
    try:
        import serial  # noqa: PLC0415 - the extra [serial]
    except ImportError as error:
        raise InputError("--port needs pyserial: pip install 'gyro-pipeline[serial]'") from error
    try:
        opened_port = serial.Serial(port, baud)
    except (OSError, ValueError) as error:
        raise InputError(
            f"--port {port}: {error}; check its name and that nothing else reads it"
        ) from error
    _open_ports.append(opened_port)
    return int(opened_port.fileno())


_open_ports: list[Any] = []  # a port is closed when it is forgotten


@main.group()
def devices() -> None:
    """List and look after the devices of the registry."""


def _registry_option(command: Callable[..., Any]) -> Callable[..., Any]:
    return click.option("--registry", type=click.Path(), help="folder of the devices")(command)


def _existing(registry: str | None, name: str) -> Device:
    device = Device(registry_folder(registry), name)
    if not device.folder.is_dir():
        known = ", ".join(d.name for d in all_devices(registry_folder(registry))) or "none"
        raise InputError(
            f"device: expected one of {known}, got {name!r}; see gyro-calibrate devices list"
        )
    return device


@devices.command("list")
@click.option("--json", "json_", is_flag=True)
@_registry_option
def list_(registry: str | None, json_: bool) -> None:
    """Devices, their types and how many calibrations count."""
    folder = registry_folder(registry)
    rows = [
        {"device": d.name, "type": d.settings().get("type"), "calibrations": len(d.calibrations())}
        for d in all_devices(folder)
    ]
    if json_:
        click.echo(json.dumps(rows))
        return
    for row in rows:
        click.echo(f"{row['device']:<24} {row['type'] or '-':<12} {row['calibrations']:>4}")
    click.echo(f"types: {', '.join(names(folder))}", err=True)


@devices.command()
@click.argument("name")
@click.option("--json", "json_", is_flag=True)
@_registry_option
def show(name: str, registry: str | None, json_: bool) -> None:
    """Level over time, temperature slope and noise of a device."""
    sys.exit(_guarded(lambda: _show(name, registry, json_)))


def _show(name: str, registry: str | None, json_: bool) -> int:
    device = _existing(registry, name)
    lines = device.lines()
    if json_:
        click.echo(json.dumps(lines))
        return DONE
    click.echo(f"{'source':<24}{'rest':>8}{'s':>8}  {'bias, deg/s':^36}{'σ, mdps':^20} history")
    kept = {line["hash"] for line in device.calibrations()}
    for line in lines:
        if line["event"] == "note":
            click.echo(f"note: {line['text']}")
        elif line["event"] == "calibration":
            mark = "" if line["hash"] in kept else "  (does not count)"
            mean = "".join(f"{m:+12.6f}" for m in line["mean_dps"] or [])
            sigma = "".join(f"{v**0.5 / MDPS:7.2f}" for v in line["variance_dps2"] or [])
            history = "/".join(line["outcome"])
            head = f"{line['source'][:23]:<24}{line['rest']:>8}{line['seconds']:8.1f}"
            click.echo(f"{head}{mean}{sigma}  {history}{mark}")
    if (device.folder / "model.json").exists():
        _show_model(json.loads((device.folder / "model.json").read_text("utf-8")))
    return DONE


def _show_model(model: dict[str, Any]) -> None:
    for axis, fitted, noise in zip(AXES, model["axes"], model["noise_mdps_rts"], strict=False):
        figures = [f"{key} {value:.3g} ± {sigma:.2g}" for key, (value, sigma) in fitted.items()]
        known = "unknown" if noise is None else f"{noise:.3g} mdps·√s"
        click.echo(f"{axis}: noise {known}; {', '.join(figures)} (mdps, √day, °C)")


@devices.command()
@click.argument("name")
@click.argument("text")
@_registry_option
def note(name: str, text: str, registry: str | None) -> None:
    """Append a note to a device's history."""
    line = {"event": "note", "time": time.time(), "text": text}
    sys.exit(_guarded(lambda: DONE if _existing(registry, name).append(line) else DONE))


@devices.command()
@click.argument("name")
@click.argument("source", required=False)
@click.option("--all", "all_", is_flag=True, help="remove the device's folder")
@_registry_option
def forget(name: str, source: str | None, all_: bool, registry: str | None) -> None:
    """Withdraw a calibration, by its file's name or hash; it stays in the file, and counts no more."""
    sys.exit(_guarded(lambda: _forget(name, source, all_, registry)))


def _forget(name: str, source: str | None, all_: bool, registry: str | None) -> int:
    device = _existing(registry, name)
    if all_:
        device.remove()
        return DONE
    lines = [line for line in device.lines() if line["event"] == "calibration"]
    of = [
        line["hash"]
        for line in lines
        if source and (line["source"] == source or line["hash"].startswith(source))
    ]
    if not of:
        shown = ", ".join(line["source"] for line in lines) or "none"
        raise InputError(
            f"forget: expected one of {shown}, or a hash, got {source!r}; or give --all"
        )
    for hash_ in of:
        device.append({"event": "forget", "time": time.time(), "of": hash_})
    return DONE


@devices.command()
@click.argument("name")
@click.argument("file", type=click.Path(dir_okay=False))
@_registry_option
def save(name: str, file: str, registry: str | None) -> None:
    """Write a device to one file."""
    sys.exit(_guarded(lambda: _save(name, Path(file), registry)))


def _save(name: str, path: Path, registry: str | None) -> int:
    device = _existing(registry, name)
    settings = device.settings_path.read_text("utf-8") if device.settings_path.exists() else ""
    content = {"schema": 1, "device": name, "device_toml": settings, "lines": device.lines()}
    path.write_text(json.dumps(content, indent=1) + "\n", "utf-8")
    return DONE


@devices.command()
@click.argument("file", type=click.Path(exists=True, dir_okay=False))
@click.option("--as", "name", help="another name")
@_registry_option
def load(file: str, name: str | None, registry: str | None) -> None:
    """Read a device from such a file; what is there already is kept, and not doubled."""
    sys.exit(_guarded(lambda: _load(Path(file), name, registry)))


def _load(path: Path, name: str | None, registry: str | None) -> int:
    try:
        content = json.loads(path.read_text("utf-8"))
        lines, settings = content["lines"], content["device_toml"]
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path}: expected a file that devices save wrote, but: {error!r}"
        ) from error
    device = Device(registry_folder(registry), name or content["device"])
    device.check_writable()
    if settings and not device.settings_path.exists():
        device.settings_path.write_text(settings, "utf-8")
    old = [{key: value for key, value in line.items()} for line in device.lines()]
    for line in lines:
        if line not in old:
            device.append({key: value for key, value in line.items() if key != "schema"})
    return DONE


@main.command()
@click.option("--target", type=float, help="standard deviation, mdps")
@click.option("--heading", help="the same as drift of a heading, such as 1deg/h")
@click.option("--device", help="name in the registry")
@click.option("--type", "device_type", help="of the device")
@click.option("--same-heading/--any-heading", default=None, help="the heading repeats")
@click.option("--latitude", type=float, help="degrees")
@click.option("--json", "json_", is_flag=True)
@_registry_option
def plan(**values: Any) -> None:
    """How many seconds at rest a standard deviation takes."""
    sys.exit(_guarded(lambda: _plan(**values)))


def _plan(
    target: float | None, heading: str | None, device: str | None, device_type: str | None,
    same_heading: bool | None, latitude: float | None, json_: bool, registry: str | None,
) -> int:  # fmt: skip
    target_mdps = _target(target, heading)
    given = opened(device, registry, device_type, same_heading, latitude)
    calibrator = Calibrator(given.kind, 100.0, given.history, given.now, target_mdps * MDPS)
    if not np.all(calibrator.freedom > 0):
        known = ", ".join(names(registry_folder(registry)))
        raise InputError(
            f"plan: expected a device of known noise; give --type ({known}) or a --device with history"
        )
    state = calibrator.state()
    if json_:
        click.echo(
            json.dumps({"target_mdps": target_mdps, "seconds": output._numbers(state.seconds_left)})
        )
    floor = given.kind.noise.floor_dps / MDPS
    for axis, (name, seconds) in enumerate(zip(AXES, state.seconds_left, strict=True)):
        if json_:
            break
        if np.isfinite(seconds):
            click.echo(
                f"{name}: {seconds:.1f} s at rest for {target_mdps:.3g} mdps ({target_mdps * 3.6:.3g}° an hour)"
            )
        elif floor[axis] > target_mdps:
            click.echo(f"{name}: not with this sensor: its floor is {floor[axis]:.2g} mdps")
        else:
            click.echo(f"{name}: not within an hour")
    return DONE if np.isfinite(state.seconds_left).all() else NOT_REACHED


def _target(target: float | None, heading: str | None) -> float:
    """The target in mdps, of one of two options."""
    if (target is None) == (heading is None):
        raise InputError("plan: expected one of --target 0.3 (mdps) and --heading 1deg/h")
    if target is not None:
        return target
    match = re.fullmatch(r"([\d.]+) *(?:deg|°)/(h|hr|hour)", str(heading))
    if match is None:
        raise InputError(f"--heading: expected such as 1deg/h, got {heading!r}")
    return float(match[1]) / output.HEADING_DEG


if __name__ == "__main__":
    main()
