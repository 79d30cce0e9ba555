"""``gyro-calibrate``: what a person types. Results go to standard output, words to standard error.

Exit codes, the highest of several files: 0 done; 2 usage; 3 target not reached; 4 not at rest;
5 history not used where --require-history asks for it; 6 data that cannot be used; 7 nothing can be
stored.
"""

import hashlib
import json
import re
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from datetime import datetime
from pathlib import Path
from typing import Any

import click
import numpy as np

import gyro_pipeline
from gyro_pipeline.calibrator import output, registry
from gyro_pipeline.calibrator.calibrator import BLOCK_S, Calibrator
from gyro_pipeline.calibrator.device_types import names
from gyro_pipeline.calibrator.registry import Device, RegistryError, registry_folder
from gyro_pipeline.calibrator.state import STILL, USED, State
from gyro_pipeline.conventions import MDPS, InputError

DONE, USAGE, NOT_REACHED, NOT_AT_REST, NO_HISTORY, UNUSABLE, NOT_STORED = 0, 2, 3, 4, 5, 6, 7

_SHORT = {"scale_dps": "scale"}  # the readers' options that have a shorter name here
_TRIPLES = {"columns", "acceleration_columns"}


def _option(default: Any, text: str, flag: str = "") -> Any:
    return field(default=default, metadata={"help": text, "flag": flag})


@dataclass
class Options:
    """What ``log`` and ``stream`` share; each field is an option of the command line."""

    device: str | None = _option(None, "name in the registry; its history is used and added to")
    device_type: str | None = _option(None, "of the device: noise, turn-on spread …", "--type")
    registry: str | None = _option(None, "folder of the devices")
    target: float | None = _option(None, "standard deviation that is wanted, mdps")
    same_heading: bool | None = _option(None, "the heading repeats", "--same-heading/--any-heading")
    latitude: float | None = _option(None, "of the place, degrees")
    started_at: str | None = _option(None, "time of the first sample, ISO 8601 or POSIX seconds")
    since_power_on: float | None = _option(None, "of the first sample, seconds")
    known_still: bool = _option(False, "it was at rest: cut nothing")
    require_history: bool = _option(False, "exit 5 where no history is used")
    store: bool = _option(True, "add to the device's history", "--store/--no-store")
    json: bool = _option(False, "one JSON object")
    plot: str | None = _option(None, "file to draw the running estimate to")
    rate: float | None = _option(None, "samples a second, where the times do not tell")
    reader: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, values: dict[str, Any]) -> "Options":
        """The shared options, and what else was given, which is for the readers."""
        shared = {item.name: values.pop(item.name) for item in fields(cls) if item.metadata}
        given = {name: _typed(name, text) for name, text in values.items() if text is not None}
        return cls(**shared, reader=given)

    def calibrator(self, rate_hz: float, without: str | None = None) -> Calibrator:
        """A calibrator of the device; see :func:`.registry.opened`."""
        given = registry.opened(
            self.device, self.registry, self.device_type, self.same_heading, self.latitude,
            _posix(self.started_at), without,
        )  # fmt: skip
        target = None if self.target is None else self.target * MDPS
        more = target, self.since_power_on, self.known_still
        return Calibrator(given.kind, rate_hz, given.history, given.now, *more)

    def folder(self) -> Device | None:
        """The device's folder; that it can be written is seen before anything is measured."""
        if self.device is None:
            return None
        device = Device(registry_folder(self.registry), self.device)
        if self.store:
            device.create(self.device_type)
        return device


def _with_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the shared options, and one for each of the readers'."""
    from gyro_pipeline.parameters import ReaderOptions  # noqa: PLC0415

    for name, info in reversed(ReaderOptions.model_fields.items()):
        text = info.description or "a name, or a number from 0"
        command = click.option(_flag(name), name, help=text, metavar="VALUE")(command)
    kinds = {float | None: float, bool: bool, bool | None: bool}
    for item in reversed([item for item in fields(Options) if item.metadata]):
        flag = item.metadata["flag"] or "--" + item.name.replace("_", "-")
        kind = kinds.get(item.type, str)
        more = {"is_flag": True} if kind is bool and "/" not in flag else {"type": kind}
        given = {"default": item.default, "help": item.metadata["help"], **more}
        command = click.option(flag, item.name, **given)(command)
    return command


def _flag(name: str) -> str:
    return "--" + _SHORT.get(name, name).replace("_", "-")


def _typed(name: str, text: str) -> Any:
    """An option's text as the readers take it."""

    def column(part: str) -> str | int:
        return int(part) if part.strip().isdigit() else part.strip()

    def number(part: str) -> str | float:
        return float(part) if re.fullmatch(r"[-+.\deE]*\d[-+.\deE]*", part) else part

    if name in _TRIPLES:
        return tuple(map(column, text.split(",")))
    if name == "rows":
        pairs = (part.partition("=") for part in text.split(","))
        return {column(key): number(value) for key, _, value in pairs}
    if name == "time_units":
        return number(text)
    return column(text) if name.endswith("_column") else text


def _reader_options(given: dict[str, Any]) -> Any:
    """The readers' options, checked."""
    from pydantic import ValidationError  # noqa: PLC0415

    from gyro_pipeline.parameters import ReaderOptions  # noqa: PLC0415

    try:
        return ReaderOptions(**given)
    except ValidationError as error:
        first = error.errors()[0]
        text = first["msg"].removeprefix("Value error, ")
        name, _, what = text.partition(": ")
        name, what = (str(first["loc"][0]), text) if first["loc"] else (name, what)
        raise InputError(f"{_flag(name)}: {what}") from error


def _in_options(message: str) -> str:
    """A reader's message with options of the command line in place of keys of a catalog."""
    from gyro_pipeline.parameters import ReaderOptions  # noqa: PLC0415
    from gyro_pipeline.readers.table import IN_READER  # noqa: PLC0415

    if IN_READER not in message:
        return message
    said, _, advice = message.replace(f" {IN_READER}", "").partition("; ")
    for name in sorted(ReaderOptions.model_fields, key=len, reverse=True):
        advice = re.sub(rf"(?<![\w-])`?{name}\b(?!-):?`?", _flag(name), advice)
    return f"{said}; {advice}"


def _say(text: str, colour: str = "yellow") -> None:
    click.secho(text, fg=colour, err=True)


class Commands(click.Group):
    """Commands that return exit codes, and whose errors are one sentence."""

    def invoke(self, ctx: click.Context) -> None:
        """Run a command, and end with its code."""
        try:
            code = super().invoke(ctx)
        except InputError as error:
            _say(_in_options(str(error)), "red")
            code = USAGE
        except RegistryError as error:
            _say(str(error), "red")
            code = NOT_STORED
        ctx.exit(code or DONE)


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(gyro_pipeline.__version__)
def main() -> None:
    """Calibrate a gyroscope at rest: its bias, a standard deviation, the seconds still needed."""


@main.command()
@click.argument("files", nargs=-1, required=True, type=click.Path(exists=True, dir_okay=False))
@_with_options
def log(files: tuple[str, ...], **values: Any) -> int:
    """Calibrate from each of some files."""
    options = Options.of(values)
    return max([_log(Path(name), options) for name in files])


def _log(path: Path, options: Options) -> int:
    """One file; returns the exit code."""
    from gyro_pipeline.readers import read_log  # noqa: PLC0415
    from gyro_pipeline.readers.table import IN_READER  # noqa: PLC0415

    device, source = options.folder(), hashlib.sha256(path.read_bytes()).hexdigest()
    reader_options = _reader_options(options.reader)
    try:
        recording = read_log(path, reader_options, options.rate)
    except InputError as error:
        _say(_in_options(str(error)), "red")
        return USAGE if IN_READER in str(error) else UNUSABLE
    for finding in recording.findings:
        if finding.outcome == "rejected":
            _say(_in_options(f"{path}: {finding.check}: {finding.detail}"), "red")
            return UNUSABLE
    rate_hz = recording.rate_hz or options.rate
    if rate_hz is None:
        raise InputError(f"{path}: expected times that tell the rate, got none; give --rate")
    calibrator = options.calibrator(rate_hz, source)
    states = _fed(calibrator, recording, 1.0 if options.plot else np.inf)
    return _report(calibrator, options, states, device, source, path.name)


def _fed(calibrator: Calibrator, recording: Any, chunk_s: float) -> list[State]:
    """Feed a log in chunks; the states after each."""
    rates, count = recording.samples, len(recording.samples)
    times = np.arange(count) / calibrator.rate_hz
    for row in recording.gap_rows:  # how long a gap is, a log does not say
        times[row:] += 2 * BLOCK_S
    columns = times, rates, recording.acceleration_g, recording.temperature_c
    step = max(round(min(chunk_s * calibrator.rate_hz, count)), 1)
    states = []
    for first in range(0, count, step):
        parts: list[Any] = [None if x is None else x[first : first + step] for x in columns]
        states.append(calibrator.update(*parts))
    return states


def _posix(text: str | None) -> float | None:
    """POSIX seconds of such, or of an ISO 8601 time."""
    if text is None:
        return None
    try:
        return (
            float(text)
            if re.fullmatch(r"[\d.]+", text)
            else datetime.fromisoformat(text).timestamp()
        )
    except ValueError as error:
        expected = "2026-01-31T12:00:00+00:00 or POSIX seconds"
        raise InputError(f"--started-at: expected {expected}, got {text!r}") from error


def _report(  # noqa: PLR0917 - what an answer is made of
    calibrator: Calibrator, options: Options, states: Sequence[State], device: Device | None,
    source: str, name: str,
) -> int:  # fmt: skip
    """Print, plot and store; returns the exit code."""
    state = calibrator.finish()
    code, evidence = _code(calibrator, state, options), calibrator.evidence()
    if options.json:
        click.echo(json.dumps(output.as_json(state, options.device, source=name), allow_nan=False))
    else:
        if code != UNUSABLE:
            past = output.describe(calibrator.prior.count, calibrator.now.same_heading)
            click.echo(output.as_text(state, options.target, evidence.temperature_c, past))
        for sentence in output.notes(state):
            _say(sentence, "red" if code in {UNUSABLE, NOT_AT_REST} else "yellow")
    if options.plot:
        output.plot(Path(options.plot), [*states, state], options.target)
    if device is not None and options.store and code != UNUSABLE:
        _store(calibrator, state, options, device, source, name)
    return code


def _store(  # noqa: PLR0917 - what a line is made of
    calibrator: Calibrator, state: State, options: Options, device: Device, source: str, name: str
) -> None:
    """Add the calibration, or the attempt, to the device's history."""
    said = {
        "hash": source, "source": name, "time": _posix(options.started_at),
        "since_power_on_s": options.since_power_on, "version": gyro_pipeline.__version__,
        "same_heading": calibrator.now.same_heading, "known_still": options.known_still,
    }  # fmt: skip
    line = registry.line_of(calibrator.evidence(), state, said, calibrator.temperature_range)
    if not device.append(line):
        _say(f"{name} is stored already; it is not stored again")
        return
    try:
        device.write_model(options.calibrator(calibrator.rate_hz))
    except RegistryError as error:
        _say(f"{name} is stored, but model.json is not made anew: {error}")


def _code(calibrator: Calibrator, state: State, options: Options) -> int:
    """The exit code of an answer."""
    if calibrator.facts.unusable or any(reason.code == "unit" for reason in state.reasons):
        return UNUSABLE
    if options.require_history and not all(outcome == USED for outcome in state.history):
        return NO_HISTORY
    if state.rest != STILL:
        return NOT_AT_REST
    return DONE if state.reached else NOT_REACHED


@main.command()
@click.option("--port", help="serial port; else standard input")
@click.option("--baud", type=int, default=115200, show_default=True)
@click.option("--timeout", type=float, default=5.0, show_default=True, help="of silence, seconds")
@_with_options
def stream(port: str | None, baud: int, timeout: float, **values: Any) -> int:
    """Calibrate from lines as they come, until the target is reached: a JSON line a second."""
    from gyro_pipeline.calibrator import stream as lines  # noqa: PLC0415

    options = Options.of(values)
    device, parser = options.folder(), lines.Parser(_reader_options(options.reader), options.rate)
    options.started_at = options.started_at or str(time.time())
    calibrator, states, ended = None, [], False

    def show(state: State) -> None:
        click.echo(json.dumps(output.as_json(state, options.device), allow_nan=False))

    with lines.source(port, baud) as descriptor:
        for samples in parser.seconds(lines.lines_of(descriptor, timeout, _say)):
            if calibrator is None:  # the first answer is the history's
                calibrator = options.calibrator(parser.rate_hz or 0.0)
                states.append(calibrator.state())
                show(states[-1])
            states.append(calibrator.update(*samples))
            if int(states[-1].time_s) > int(states[-2].time_s):
                show(states[-1])
            ended = options.target is not None and states[-1].done
            if ended:
                break
    if calibrator is None:
        raise InputError("stream: expected lines of samples, got none; check what sends them")
    if parser.bad:
        _say(f"{parser.bad} lines were of another shape and were left out")
    source = hashlib.sha256(f"{options.started_at} {states[-1].own_dps}".encode()).hexdigest()
    return _report(calibrator, options, states, device, source, port or "standard input")


_registry_option = click.option("--registry", "folder", help="folder of the devices")
_json_option = click.option("--json", "as_json", is_flag=True, help="JSON")


@main.command()
@click.option("--target", type=float, help="standard deviation, mdps")
@click.option("--heading", help="the same as the drift of a heading, such as 1deg/h")
@click.option("--device", help="name in the registry")
@click.option("--type", "device_type", help="of the device")
@click.option("--same-heading/--any-heading", default=None, help="the heading repeats")
@click.option("--latitude", type=float, help="degrees")
@_json_option
@_registry_option
def plan(target: float | None, heading: str | None, as_json: bool, **values: Any) -> int:
    """How many seconds at rest a standard deviation takes."""
    target_mdps = _target(target, heading)
    options = Options(registry=values.pop("folder"), target=target_mdps, **values)
    calibrator = options.calibrator(100.0)
    if not np.all(calibrator.freedom > 0):
        known = ", ".join(names(registry_folder(options.registry)))
        text = f"expected a device of known noise; give --type ({known}) or a --device with history"
        raise InputError(f"plan: {text}")
    seconds = calibrator.state().seconds_left
    if as_json:
        numbers = output.numbers(seconds)
        click.echo(json.dumps({"target_mdps": target_mdps, "seconds": numbers}))
    else:
        floors = calibrator.kind.noise.floor_dps / MDPS
        click.echo("\n".join(output.planned(seconds, floors, target_mdps)))
    return DONE if np.isfinite(seconds).all() else NOT_REACHED


def _target(target: float | None, heading: str | None) -> float:
    """The target in mdps, of one of two options."""
    if (target is None) == (heading is None):
        raise InputError("plan: expected either --target 0.3 (mdps) or --heading 1deg/h")
    if target is not None:
        return target
    match = re.fullmatch(r"([\d.]+) *(?:deg|°)/(?:h|hr|hour)", str(heading))
    if match is None:
        raise InputError(f"--heading: expected such as 1deg/h, got {heading!r}")
    return float(match[1]) / output.HEADING_DEG


@main.group(cls=Commands)
def devices() -> None:
    """List and look after the devices of the registry."""


def _existing(folder: str | None, name: str) -> Device:
    device, known = Device(registry_folder(folder), name), registry.devices(registry_folder(folder))
    if not device.folder.is_dir():
        listed = ", ".join(d.name for d in known) or "none"
        raise InputError(f"device: expected one of {listed}, got {name!r}; see devices list")
    return device


@devices.command("list")
@_json_option
@_registry_option
def list_devices(folder: str | None, as_json: bool) -> None:
    """Devices, their types and how many calibrations count."""
    rows = [
        {"device": d.name, "type": d.settings().get("type"), "calibrations": len(d.calibrations())}
        for d in registry.devices(registry_folder(folder))
    ]
    click.echo(json.dumps(rows) if as_json else "\n".join(map(output.device_row, rows)))
    _say(f"types: {', '.join(names(registry_folder(folder)))}")


@devices.command()
@click.argument("name")
@_json_option
@_registry_option
def show(name: str, folder: str | None, as_json: bool) -> None:
    """Level over time, turn-on spread, walk, temperature slope and noise of a device."""
    device = _existing(folder, name)
    lines, model = device.lines(), device.model()
    if as_json:
        click.echo(json.dumps({"lines": lines, "model": model}))
    else:
        counting = {line["hash"] for line in device.calibrations()}
        click.echo("\n".join(output.device_table(lines, counting, model)))


@devices.command()
@click.argument("name")
@click.argument("text")
@_registry_option
def note(name: str, text: str, folder: str | None) -> None:
    """Append a note to a device's history."""
    _existing(folder, name).append({"event": "note", "time": time.time(), "text": text})


@devices.command()
@click.argument("name")
@click.argument("source", required=False)
@click.option("--all", "everything", is_flag=True, help="remove the device's folder")
@_registry_option
def forget(name: str, source: str | None, everything: bool, folder: str | None) -> None:
    """Withdraw a calibration, by its file's name or hash: it stays stored, and counts no more."""
    device = _existing(folder, name)
    if everything:
        device.remove()
        return
    lines = [line for line in device.lines() if line["event"] == "calibration"]
    chosen = [
        line["hash"] for line in lines
        if source and (line["source"] == source or line["hash"].startswith(source))
    ]  # fmt: skip
    if not chosen:
        known = ", ".join(line["source"] for line in lines) or "none"
        raise InputError(f"forget: expected one of {known}, or a hash, got {source!r}; or --all")
    for withdrawn in chosen:
        device.append({"event": "forget", "time": time.time(), "of": withdrawn})


@devices.command()
@click.argument("name")
@click.argument("file", type=click.Path(dir_okay=False))
@_registry_option
def save(name: str, file: str, folder: str | None) -> None:
    """Write a device to one file."""
    Path(file).write_text(json.dumps(_existing(folder, name).content(), indent=1) + "\n", "utf-8")


@devices.command()
@click.argument("file", type=click.Path(exists=True, dir_okay=False))
@click.option("--as", "name", help="another name")
@_registry_option
def load(file: str, name: str | None, folder: str | None) -> None:
    """Read a device from such a file; what is there already is kept, and nothing is doubled."""
    try:
        content = json.loads(Path(file).read_text("utf-8"))
        device = Device(registry_folder(folder), name or content["device"])
        lines, settings = content["lines"], content["device_toml"]
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{file}: expected what devices save writes, but: {error!r}") from error
    device.restore(lines, settings)


if __name__ == "__main__":
    sys.exit(main())
