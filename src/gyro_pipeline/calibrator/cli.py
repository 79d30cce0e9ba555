"""The command line ``gyro-calibrate``. Results go to standard output, remarks to standard error.

The exit code is the highest of all files: 0 done; 2 usage; 3 target not reached; 4 not at rest;
5 history not used, with --require-history; 6 data unusable; 7 nothing can be stored.
"""

import errno
import hashlib
import json
import re
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from datetime import datetime
from functools import reduce
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import numpy as np
from click import argument, option

import gyro_pipeline
from gyro_pipeline.calibrator import output
from gyro_pipeline.calibrator.calibrator import Calibrator, State
from gyro_pipeline.calibrator.device_types import type_names
from gyro_pipeline.calibrator.history import STILL, USED, Calibration
from gyro_pipeline.calibrator.reasons import Reason
from gyro_pipeline.calibrator.registry import SET, Device, RegistryError, registry_folder
from gyro_pipeline.calibrator.stretch import BLOCK_S
from gyro_pipeline.conventions import AXES, IN_READER, MDPS, InputError
from gyro_pipeline.parameters import ReaderOptions

_ARGUMENT = r"^(rate_hz|target|latitude|since_power_on|type)(?=:)"  # of Calibrator.open
_LONGEST_S = 86400.0  # of silence
_UNKNOWN_HZ = 100.0  # stands for the rate before samples show it
_COLUMN = "a name, or a number from 0"
DONE, USAGE, NOT_REACHED, NOT_AT_REST, NO_HISTORY, UNUSABLE, NOT_STORED = 0, 2, 3, 4, 5, 6, 7


def _posix_seconds(_: click.Context, __: click.Parameter, text: str | None) -> float | None:
    try:
        return datetime.fromisoformat(text).timestamp() if text else None
    except ValueError as error:
        raise InputError(f"--started-at: expected 2026-01-31T12:00:00Z, got {text!r}") from error


def _flag(name: str) -> str:
    return "--scale" if name == "scale_dps" else "--" + name.replace("_", "-")


def _typed(advice: str, end: str = r"\b(?!-):?") -> str:
    """Advice about catalog keys, with options and values as they are typed."""
    advice = re.sub(r"(the sensor's )?\brate_hz(, or samples and recording_s)?", "--rate", advice)
    advice = advice.replace("scale_dps", "--scale")
    for name in sorted(ReaderOptions.model_fields, key=len, reverse=True):
        advice = re.sub(rf"(?<![\w-]){name}{end}", _flag(name), advice)
    advice = re.sub(r"\[([^\]]*)\]", lambda match: match[1].replace(", ", ","), advice)
    return re.sub(r"\{(\w+): (\w+)\}", r"\1=\2", advice).replace("`", "")


def _existing_device(context: click.Context, _: click.Parameter, name: str) -> Device:
    device = Device(context.params["registry"], name)
    if not device.folder.is_dir():
        listed = ", ".join(d.name for d in Device.all(context.params["registry"])) or "none"
        raise InputError(f"device: expected one of {listed}, got {name!r}; see devices list")
    return device


_REGISTRY = option(
    "--registry", help="folder of the registry", is_eager=True,  # the device needs it
    callback=lambda _, __, path: registry_folder(path),
)  # fmt: skip
_DEVICE = argument("device", metavar="NAME", callback=_existing_device)
_TYPE = option("--type", "device_type", help="type of the device: noise, turn-on spread, ...")
_JSON = option("--json", "as_json", is_flag=True, help="one JSON object")
_OPENING = (  # arguments of Calibrator.open
    option("--device", help="name in the registry; its history is used and added to"),
    _TYPE,
    _REGISTRY,
    option("--target", "target_mdps", type=float, help="standard deviation to reach, mdps"),
    option("--same-heading/--any-heading", default=None, help="whether the heading repeats"),
    option("--latitude", "latitude_deg", type=float, help="latitude, degrees"),
)
_TIME: dict[str, Any] = {"metavar": "TIME", "callback": _posix_seconds}
_MEASURING = (  # of log and stream; the first three are arguments of Calibrator.open as well
    option("--started-at", **_TIME, help="of the first sample, ISO 8601"),
    option("--since-power-on", "since_power_on_s", type=float, help="age of the first sample, s"),
    option("--known-still", is_flag=True, help="it is at rest: cut nothing"),
    option("--require-history", is_flag=True, help="exit 5 if it is not used"),
    option("--store/--no-store", default=True, help="add to the device's history"),
    option("--plot", type=Path, help="file for a plot of the running estimate"),
    option("--rate", "rate_hz", type=float, help="samples per second, if times do not show it"),
    _JSON,
)
_READING = tuple(
    option(_flag(name), name, metavar="VALUE", help=_typed(f.description or _COLUMN, ":"))
    for name, f in ReaderOptions.model_fields.items()
)


def _with(*options: Any) -> Callable[[Any], Any]:
    """A decorator that adds parameters, which the help lists in this order."""
    return lambda command: reduce(lambda done, add: add(done), reversed(options), command)


def _read_reader_options(texts: dict[str, str]) -> Any:
    """Options of the readers from their texts: lists with commas, ``rows`` as COLUMN=VALUE."""
    from pydantic import ValidationError  # noqa: PLC0415

    values: Any = {name: _parse(text) for name, text in texts.items() if text is not None}
    for name in {"columns", "acceleration_columns"} & values.keys():
        values[name] = [_parse(part) for part in texts[name].split(",")]
    if "rows" in values:
        pairs = (part.partition("=") for part in texts["rows"].split(","))
        values["rows"] = {_parse(column): _parse(value) for column, _, value in pairs}
    try:
        return ReaderOptions(**values)
    except ValidationError as error:
        first = error.errors()[0]
        text = first["msg"].removeprefix("Value error, ")
        name, _, rest = text.partition(": ")
        if first["loc"]:
            name = str(first["loc"][0])
            rest = text.removeprefix(f"{name}: ")
        raise InputError(f"{_flag(name)}: {_typed(rest, ':')}") from error


def _parse(text: str) -> Any:
    """A number, true or false; any other text as it is."""
    try:
        return json.loads(text)
    except ValueError:
        return text.strip()


def _name_options(message: str) -> str:
    """A message, with options of the command line in place of catalog keys and arguments."""
    message = re.sub(_ARGUMENT, lambda match: _flag(match[1].removesuffix("_hz")), message)
    if IN_READER not in message:
        return message
    text, *advice = message.replace(f" {IN_READER}", "").split("; ", 1)
    named = re.sub(r"`(\w+)\b[^`]*`", lambda match: _typed(match[0]), text)
    return "; ".join([named, *map(_typed, advice)])


def _remark(text: str, colour: str = "yellow") -> None:
    click.secho(text, fg=colour, err=True)


def _print(as_json: bool, result: Any, lines: Iterable[str]) -> None:
    """Print a result; nothing more is printed where standard output is full or closed."""
    try:
        click.echo(json.dumps(result, allow_nan=False) if as_json else "\n".join(lines))
    except OSError:
        sys.stdout = None  # which Python would flush again at the exit
        raise


def _changed(as_json: bool, device: Device, **what: Any) -> None:
    if as_json:
        _print(True, {"device": device.name, **what}, ())


def _code_of(command: Callable[..., Any], *arguments: Any) -> int:
    """The exit code that a command returns, or that of the error it raises, which is shown."""
    try:
        return command(*arguments) or DONE
    except (InputError, RegistryError) as error:
        _remark(_name_options(str(error)), "red")
        return USAGE if isinstance(error, InputError) else NOT_STORED
    except OSError as error:
        if error.errno == errno.EPIPE:  # the reader of the results has seen enough
            return DONE
        where = error.filename or "standard output"
        _remark(f"{where}: not read or written: {error.strerror}; give another file", "red")
        return USAGE


class Commands(click.Group):
    """Commands that return exit codes, and whose errors are shown as a sentence."""

    def invoke(self, ctx: click.Context) -> None:
        """Run a command and exit with its code."""
        ctx.exit(_code_of(super().invoke, ctx))


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(gyro_pipeline.__version__)
def main() -> None:
    """Calibrate a gyroscope at rest: its bias, a standard deviation, the seconds still needed."""


def _job(store: bool, **values: Any) -> SimpleNamespace:
    """The options of ``log`` and ``stream``; ``opening`` is for :meth:`.Calibrator.open`.

    Everything that can be refused without samples is refused here, before anything is read.
    """
    reader = _read_reader_options({name: values.pop(name) for name in ReaderOptions.model_fields})
    names = "require_history", "plot", "rate_hz", "as_json"
    job = SimpleNamespace(reader=reader, device=None, **{name: values.pop(name) for name in names})
    if job.plot:
        output.check_plot(job.plot)
    Calibrator.open(rate_hz=_UNKNOWN_HZ if job.rate_hz is None else job.rate_hz, **values)
    if values["device"] is not None and store:
        job.device = Device(values["registry"], values["device"])
        job.device.create(values["device_type"])
    job.opening = values
    return job


@main.command()
@argument("files", nargs=-1, required=True, type=click.Path(path_type=Path))
@_with(*_OPENING, *_MEASURING, *_READING)
def log(files: tuple[Path, ...], **values: Any) -> int:
    """Calibrate from log files, one after the other."""
    for name in ("plot", "started_at", "since_power_on"):  # of one log
        if values.get(name, values.get(f"{name}_s")) is not None and len(files) > 1:
            text = f"expected one log, got {len(files)}; calibrate them one by one"
            raise InputError(f"{_flag(name)}: {text}")
    job = _job(**values)
    return max(_answer(job, path.name, _calibrate, path, job) for path in files)


def _answer(job: SimpleNamespace, name: str, command: Callable[..., int], *arguments: Any) -> int:
    """The exit code of a calibration; with --json, a refusal is an object as well.

    A refusal is a matter of usage where an option would help, and else, or where the data
    contradict the options, of data that cannot be used.
    """
    try:
        return command(*arguments)
    except InputError as error:
        sentence = _name_options(str(error))
        _remark(sentence, "red")
        if job.as_json:
            _code_of(_print, True, output.refused(sentence, job.opening["device"], name), ())
        lacking = IN_READER in str(error) and "trust: options" not in str(error)
        missing = isinstance(error.__cause__, FileNotFoundError)
        return USAGE if missing or lacking or "; give --" in str(error) else UNUSABLE


def _calibrate(path: Path, job: SimpleNamespace) -> int:
    from gyro_pipeline.readers import read_log  # noqa: PLC0415

    recording = read_log(path, job.reader, job.rate_hz)
    for finding in recording.findings:
        if finding.outcome == "rejected":
            text = f"{path}: {finding.check}: {finding.detail} {IN_READER}"
            raise InputError(_name_options(text))
    rate_hz = recording.rate_hz or job.rate_hz
    if rate_hz is None:
        raise InputError(f"{path}: expected times that show the rate, got none; give --rate")
    source = hashlib.sha256(path.read_bytes()).hexdigest()
    calibrator = Calibrator.open(rate_hz=rate_hz, **job.opening, without=source)
    states = _feed(calibrator, recording, 1.0 if job.plot else np.inf)
    return _report(calibrator, job, states, source, path.name)


def _feed(calibrator: Calibrator, recording: Any, chunk_s: float) -> list[State]:
    count, rate_hz = len(recording.samples), calibrator.setup.rate_hz
    times = np.arange(count) / rate_hz
    for row in recording.gap_rows:  # one of unknown length becomes a jump of the clock
        lost = 0.0 if recording.lost is None else recording.lost[row]
        times[row:] += lost / rate_hz if lost > 0 else -2 * BLOCK_S
    columns = times, recording.samples, recording.acceleration_g, recording.temperature_c
    step, states = max(round(min(chunk_s * rate_hz, count)), 1), []
    for row in range(0, count, step):
        chunk: list[Any] = [None if x is None else x[row : row + step] for x in columns]
        states.append(calibrator.update(*chunk))
    return states


def _report(
    calibrator: Calibrator, job: SimpleNamespace, states: Sequence[State], source: str, name: str
) -> int:
    """Store, print and plot the result; returns the exit code."""
    state = calibrator.finish()
    result = _exit_code(state, job.require_history)
    codes = [result]
    if job.device is not None and result != UNUSABLE:
        codes.append(_code_of(_store, calibrator, job, source, name))
    if job.as_json or result != UNUSABLE:
        content = output.as_json(state, job.opening["device"], source=name)
        codes.append(_code_of(_print, job.as_json, content, output.as_text(state)))
    if not job.as_json:
        for sentence in output.notes(state):
            _remark(sentence, "red" if result in {UNUSABLE, NOT_AT_REST} else "yellow")
    if job.plot:
        codes.append(_code_of(output.plot, job.plot, [*states, state]))
    return max(codes)


def _store(calibrator: Calibrator, job: SimpleNamespace, source: str, name: str) -> None:
    version, rate_hz = gyro_pipeline.__version__, calibrator.setup.rate_hz
    stored = replace(calibrator.calibration(), hash=source, source=name, version=version)
    if not job.device.append(stored):
        _remark(f"{name} is stored already; it is not stored again")
        return
    try:
        job.device.write_model(Calibrator.open(rate_hz=rate_hz, **job.opening).setup)
    except RegistryError as error:
        _remark(f"{name} is stored, but model.json was not updated: {error}")


def _exit_code(state: State, require_history: bool) -> int:
    if state.unusable:
        return UNUSABLE
    if require_history and set(state.history) != {USED}:
        return NO_HISTORY
    if state.rest != STILL:
        return NOT_AT_REST
    return DONE if state.reached else NOT_REACHED


@main.command()
@option("--port", help="serial port instead of standard input")
@option("--baud", type=int, default=115200, show_default=True)
@option("--timeout", type=float, default=5.0, show_default=True, help="seconds of silence")
@_with(*_OPENING, *_MEASURING, *_READING)
def stream(port: str | None, baud: int, timeout: float, **values: Any) -> int:
    """Calibrate from a live stream until the target is reached; prints a JSON line a second."""
    from gyro_pipeline.calibrator import stream as lines  # noqa: PLC0415

    if not 0 < timeout <= _LONGEST_S:
        raise InputError(f"--timeout: expected more than 0 and at most a day, got {timeout:g} s")
    job, name = _job(**values), port or "standard input"
    job.opening["started_at"] = job.opening["started_at"] or time.time()
    parser = lines.Parser(job.reader, job.rate_hz, port is not None)
    with lines.interruption() as interrupted, lines.source(port, baud) as descriptor:
        received = parser.lines_of([descriptor, interrupted], timeout, _remark)
        return _answer(job, name, _follow, parser, parser.seconds(received), job, name)


def _follow(parser: Any, seconds: Iterable[Any], job: SimpleNamespace, name: str) -> int:
    """Calibrate until the target is reached, or the samples or standard output end."""
    calibrator = Calibrator.open(rate_hz=job.rate_hz or _UNKNOWN_HZ, **job.opening)
    states, target, out = [calibrator.state()], job.opening["target_mdps"], sys.stdout

    def show(state: State) -> int:
        return _code_of(_print, True, output.as_json(state, job.opening["device"]), ())

    code = show(states[0])  # the history's, before any sample
    for samples in seconds:
        if calibrator.setup.rate_hz != parser.rate_hz:
            calibrator = Calibrator.open(rate_hz=parser.rate_hz, **job.opening)
        state = calibrator.update(*samples)
        if int(state.time_s) > int(states[-1].time_s):
            code = max(code, show(state))
            states.append(state)
        if (state.done and target is not None) or sys.stdout is not out:
            break
    if not calibrator.counts["samples"]:
        raise InputError("stream: expected samples, got none; check the program that sends them")
    parser.check_rate()
    if parser.doubt:
        _remark(parser.doubt)
    if parser.bad:
        _remark(f"{parser.bad} lines were of another shape and were left out")
    source = hashlib.sha256(f"{name} {job.opening['started_at']}".encode()).hexdigest()
    return max(code, _report(calibrator, job, states, source, name))


@main.command()
@option("--heading", help="drift of the heading instead of --target, such as 1deg/h")
@_with(*_OPENING, _JSON)
def plan(heading: str | None, as_json: bool, **opening: Any) -> int:
    """Predict the seconds at rest that a standard deviation takes."""
    target_mdps = opening["target_mdps"]
    if (heading is None) == (target_mdps is None):
        raise InputError("plan: expected either --target 0.3 (mdps) or --heading 1deg/h")
    if heading is not None:
        target_mdps = opening["target_mdps"] = _heading_mdps(heading)
    calibrator = Calibrator.open(rate_hz=100.0, **opening)
    if not calibrator.setup.noise_known:
        listed = ", ".join(type_names(opening["registry"]))
        text = f"expected a device of known noise; give --type ({listed})"
        raise InputError(f"plan: {text} or a --device with history")
    state = calibrator.state()
    lines, seconds = list(output.planned(state)), output.numbers(state.seconds_left)
    why = [vars(Reason("unreached", lines[n], AXES[n])) for n in range(3) if seconds[n] is None]
    _print(as_json, {"target_mdps": target_mdps, "seconds": seconds, "reasons": why}, lines)
    return DONE if np.isfinite(state.seconds_left).all() else NOT_REACHED


def _heading_mdps(text: str) -> float:
    """A rate such as 1deg/h, in mdps."""
    from gyro_pipeline.units import read_unit  # noqa: PLC0415

    match = re.fullmatch(r"(\d+\.?\d*|\.\d+) *(.+)", text)
    unit = read_unit(match[2]) if match else None
    if match is None or unit is None or unit.quantity != "rate":
        raise InputError(f"--heading: expected a rate such as 1deg/h, got {text!r}")
    return float(match[1]) * unit.factor / MDPS


@main.group()
def devices() -> None:
    """List and manage the devices of the registry."""


@devices.command("list")
@_with(_REGISTRY, _JSON)
def list_devices(registry: Path, as_json: bool) -> int:
    """List devices, their types and the number of calibrations that count."""
    rows, codes = [], [DONE]

    def add(device: Device) -> None:
        counts = {"type": device.settings().type, "calibrations": len(device.history())}
        rows.append({"device": device.name, **counts})

    codes += [_code_of(add, device) for device in Device.all(registry)]
    _print(as_json, rows, output.device_list(rows, type_names(registry)))
    return max(codes)


@devices.command()
@_with(_DEVICE, _REGISTRY, _JSON)
def show(device: Device, as_json: bool, **_: Any) -> None:
    """Show level over time, turn-on spread, walk, temperature slope, noise and health."""
    content = {"lines": device.lines(), "model": device.model()}
    _print(as_json, content, output.device_table(device))


@devices.command()
@_DEVICE
@argument("text")
@option("--knocked", is_flag=True, help="it was knocked or dropped: what came before counts less")
@_with(_REGISTRY, _JSON)
def note(device: Device, text: str, knocked: bool, as_json: bool, **_: Any) -> None:
    """Append a note to the history of a device."""
    device.append({"event": "note", "time": time.time(), "text": text, "knocked": knocked})
    _changed(as_json, device, noted=text)


@devices.command("set", context_settings={"ignore_unknown_options": True})  # -0.1 is a number
@argument("name")
@argument("bias_dps", nargs=3, type=float)
@option("--sigma", type=float, required=True, help="its standard deviation, mdps")
@_with(_REGISTRY, _TYPE, _JSON)
def set_bias(
    name: str, bias_dps: tuple[float, float, float], sigma: float, registry: Path,
    device_type: str | None, as_json: bool,
) -> None:  # fmt: skip
    """Set a bias, deg/s about x, y and z, which replaces the history until it is forgotten."""
    if not (np.isfinite(bias_dps).all() and 0 < sigma < np.inf):
        text = f"{' '.join(map(str, bias_dps))} --sigma {sigma:g}"
        raise InputError(f"set: expected three rates in deg/s, and a sigma above 0, got {text}")
    device, variance = Device(registry, name), (sigma * MDPS) ** 2
    device.create(device_type)
    typed: Any = {"time": time.time(), "hash": SET, "source": SET, "event": SET}
    device.append(Calibration(bias_dps, (variance,) * 3, knocks=device.knocks(), **typed))
    _changed(as_json, device, bias_dps=bias_dps)


@devices.command()
@_DEVICE
@argument("source", required=False)
@option("--all", "everything", is_flag=True, help="remove the device's folder")
@_with(_REGISTRY, _JSON)
def forget(device: Device, source: str | None, everything: bool, as_json: bool, **_: Any) -> None:
    """Withdraw a calibration by the name or hash of its file; it stays stored without counting."""
    if everything:
        shutil.rmtree(device.folder)
        return _changed(as_json, device, forgotten="all")
    stored = device.calibrations()
    by_name = [key for key, c in stored.items() if c.source == source]
    hashes = by_name or [key for key in stored if source and key.startswith(source)]
    if not by_name and len(hashes) != 1:
        listed = ", ".join(c.source for c in stored.values()) or "none"
        raise InputError(f"forget: expected one of {listed}, or a hash, got {source!r}; or --all")
    for withdrawn in hashes:
        device.append({"event": "forget", "time": time.time(), "of": withdrawn})
    _changed(as_json, device, forgotten=hashes)


@devices.command()
@_DEVICE
@argument("file", type=click.Path(dir_okay=False, path_type=Path))
@_with(_REGISTRY, _JSON)
def save(device: Device, file: Path, as_json: bool, **_: Any) -> None:
    """Write a device to a file."""
    file.write_text(json.dumps(device.content(), indent=1) + "\n", "utf-8")
    _changed(as_json, device, saved=str(file))


@devices.command()
@argument("file", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@option("--as", "name", help="new name of the device")
@_with(_REGISTRY, _JSON)
def load(file: Path, name: str | None, registry: Path, as_json: bool) -> None:
    """Read a device from a file that ``devices save`` wrote; stored lines are kept, once each."""
    try:
        content = json.loads(file.read_text("utf-8"))
        device = Device(registry, name or content["device"])
        device.restore(content, str(file))
    except (AttributeError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{file}: expected a file from devices save, but: {error!r}") from error
    _changed(as_json, device, loaded=len(content["lines"]))


if __name__ == "__main__":
    sys.exit(main())
