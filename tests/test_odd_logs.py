"""Logs that once gave a silent wrong number, or were lost: how each kind ends now.

A kind is written as a file, read, and judged. It either ends in a message that names what to do, or
is kept with the right bias. Values are invented; the kinds come from public logs and reports.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from gyro_pipeline.conventions import InputError
from gyro_pipeline.logs import REJECTED
from gyro_pipeline.parameters import Quality, ReaderOptions
from gyro_pipeline.quality import inspect
from gyro_pipeline.readers import read_log

CONF = Path(__file__).parents[1] / "conf" / "base"
QUALITY = Quality(**yaml.safe_load((CONF / "parameters/stages.yml").read_text())["quality"])
TRUTH = (0.7, -0.4, 0.15)
RATE = 100.0
RAD = np.pi / 180


@dataclass(frozen=True)
class Ending:
    """How a file ended: refused with a message, or judged."""

    message: str = ""
    outcome: str = ""
    bias: NDArray[np.float64] | None = None
    rate_hz: float | None = None
    findings: str = ""


def ending(path: Path, rate_hz: float | None = RATE, **options: Any) -> Ending:
    try:
        log = read_log(path, ReaderOptions(**options), rate_hz)
    except InputError as error:
        return Ending(message=str(error))
    judged = inspect(log, log.rate_hz or rate_hz, QUALITY)
    kept = log.samples[judged.start : judged.stop][~judged.masked]
    findings = "; ".join(f"{one.check}: {one.detail}" for one in judged.findings)
    bias = kept.mean(axis=0) if len(kept) else None
    return Ending("", judged.outcome, bias, log.rate_hz, findings)


def refused(end: Ending, *words: str) -> None:
    assert end.message, f"expected a refusal, got {end}"
    for word in words:
        assert re.search(word, end.message, re.IGNORECASE), (word, end.message)


def rejected(end: Ending, *words: str) -> None:
    assert end.outcome == REJECTED, end
    for word in words:
        assert re.search(word, end.findings, re.IGNORECASE), (word, end.findings)


def kept(end: Ending, bias: Sequence[float] = TRUTH, *words: str, within: float = 0.01) -> None:
    assert end.bias is not None and end.outcome != REJECTED, end
    np.testing.assert_allclose(end.bias, bias, atol=within)
    for word in words:
        assert re.search(word, end.findings, re.IGNORECASE), (word, end.findings)


def still(
    n: int = 6000, bias: Sequence[float] = TRUTH, seed: int = 0, noise: float = 0.05
) -> NDArray[np.float64]:
    return np.random.default_rng(seed).normal(bias, noise, (n, 3))


def seconds(n: int, rate_hz: float = RATE) -> NDArray[np.float64]:
    return np.arange(n) / rate_hz


def text(path: Path, header: str, *columns: Any, sep: str = ",", digits: int = 6) -> Path:
    """A text of a header and columns: numbers, or texts."""
    cells = [
        [
            value if isinstance(value, str) else f"{value:.{digits}f}".rstrip("0").rstrip(".")
            for value in np.asarray(column).tolist()
        ]
        for block in columns
        for column in np.atleast_2d(np.asarray(block).T)
    ]
    rows = [sep.join(row) for row in zip(*cells, strict=True)]
    path.write_text("\n".join([*([header] if header else []), *rows]) + "\n")
    return path


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "log.csv"


# -- a recording is of one device ------------------------------------------------------------

DEVICES = [(1, -0.5, 0.25), (-0.3, 0.7, 0.1), (0.2, 0.1, -0.6)]


def several_devices(order: NDArray[np.intp]) -> NDArray[np.float64]:
    generator = np.random.default_rng(1)
    return np.array(DEVICES)[order] + generator.normal(0, 0.05, (len(order), 3))


def slipping(n: int) -> NDArray[np.intp]:
    order = np.arange(n) % 2
    for row in (1000, 3501, 7002):
        order[row:] = 1 - order[row:]
    return order


ORDERS = {
    "three in turn": np.arange(9000) % 3,
    "two in turn": np.arange(9000) % 2,
    "in bursts": np.arange(9000) // 50 % 3,
    "at random": np.random.default_rng(3).integers(0, 3, 9000),
    "phase slips": slipping(9000),
}


@pytest.mark.parametrize("name", ORDERS)
def test_kind_1_devices_that_take_turns_are_refused_and_rows_picks(path: Path, name: str) -> None:
    order = ORDERS[name]
    rates = several_devices(order)
    header = "time (s),sensor,gx (deg/s),gy (deg/s),gz (deg/s)"
    text(path, header, seconds(9000, 300), order + 1, rates)
    refused(ending(path, None), "'?sensor'?", "rows:", "reader")
    if name == "in bursts":  # what a device measures in bursts has gaps
        rejected(ending(path, None, rows={"sensor": 1}), "too short")
    else:
        kept(ending(path, None, rows={"sensor": 1}), DEVICES[0])


@pytest.mark.parametrize("order", ORDERS.values(), ids=ORDERS)
def test_kind_1_a_text_column_says_what_a_row_is(path: Path, order: NDArray[np.intp]) -> None:
    rates = several_devices(order)
    names = np.array(["gyr", "acc", "mag"])[order]
    text(path, "time (s),kind,x (deg/s),y (deg/s),z (deg/s)", seconds(9000, 300), names, rates)
    refused(ending(path, None), "kind", "rows:", "gyr", "acc")


@pytest.mark.parametrize("order", ORDERS.values(), ids=ORDERS)
def test_kind_1_devices_that_take_turns_without_a_column_are_never_kept(
    path: Path, order: NDArray[np.intp]
) -> None:
    text(path, "gx (deg/s),gy (deg/s),gz (deg/s)", several_devices(order))
    end = ending(path)
    assert end.message or end.outcome == REJECTED, end


def test_kind_1_columns_that_take_turns_and_say_nothing_of_the_row_do_no_harm(path: Path) -> None:
    generator = np.random.default_rng(0)
    n = 6000
    warmth = 25 + 0.1 * generator.integers(0, 2, n)
    sync = (np.arange(n) % 10 == 0).astype(int)
    hundredths = np.arange(n) % 100
    header = "time (s),temp (degC),sync,hundredths,status,gx (deg/s),gy (deg/s),gz (deg/s)"
    text(path, header, seconds(n), warmth, sync, hundredths, np.ones(n), still(n))
    kept(ending(path, None))


@pytest.mark.parametrize("k", [2, 10, 40])
def test_kind_3_samples_written_several_times_say_their_true_share(path: Path, k: int) -> None:
    rates = np.repeat(still(60_000 // k), k, axis=0)
    text(path, "time (s),gx (deg/s),gy (deg/s),gz (deg/s)", seconds(60_000, 1000), rates)
    rejected(ending(path, None), rf"{100 - 100 / k:g}(\.0)?%", "repeats: drop")
    if k == 10:
        end = ending(path, None, repeats="drop")
        kept(end)
        assert end.rate_hz == pytest.approx(100, rel=0.01)


# -- a column is a rate only if it says so ---------------------------------------------------


def dot_header(*, more: str = "") -> str:
    return f"PacketCounter,SampleTimeFine,Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z{more}"


@pytest.mark.parametrize("more", ["", ",Quat_q0"])
def test_kind_2_a_header_that_two_vendors_write_asks_for_the_unit(path: Path, more: str) -> None:
    n = 6000
    acceleration = np.random.default_rng(2).normal((0, 0, 9.8), 0.02, (n, 3))
    columns = [np.arange(n), [""] * n, acceleration, still(n, (0.0175, 0.01, 0.02), noise=0.001)]
    columns += [np.ones(n)] if more else []
    text(path, dot_header(more=more), *columns)
    refused(ending(path), "units", "reader")
    kept(ending(path, units="rad/s"), (0.0175 / RAD, 0.01 / RAD, 0.02 / RAD))


def test_kind_4_names_put_axes_in_order(path: Path) -> None:
    rates = still()[:, ::-1]
    text(path, "time (s),gz,gy,gx", seconds(6000), rates)
    kept(ending(path, None, units="deg/s"))
    refused(ending(path, None, units="deg/s", columns=[1, 2, 3]), "gz", "trust: options")
    swapped = ending(path, None, units="deg/s", columns=[1, 2, 3], trust="options")
    kept(swapped, TRUTH[::-1])


@pytest.mark.parametrize("names", ["ax,ay,az", "roll,pitch,yaw", "mx,my,mz", "accX,accY,accZ"])
def test_kind_4_nothing_but_rates_is_taken_for_rates(path: Path, names: str) -> None:
    text(path, f"time (s),{names}", seconds(6000), still())
    refused(ending(path, None, units="deg/s"), "columns|rate")
    refused(
        ending(path, None, units="deg/s", columns=[1, 2, 3]),
        names.split(",", maxsplit=1)[0],
        "trust",
    )


def test_kind_5_a_level_that_no_gyroscope_has_asks_for_an_offset(path: Path) -> None:
    counts = np.rint(32768 + still() / 0.01)
    text(path, "time (s),gx,gy,gz", seconds(6000), counts)
    options: dict[str, Any] = {"units": "raw", "scale_dps": 0.01}
    refused(ending(path, None, **options), "offset")
    kept(ending(path, None, **options, offset=32768))
    flying = still(bias=(130, 0, 0))
    text(path, "time (s),gx (deg/s),gy (deg/s),gz (deg/s)", seconds(6000), flying)
    refused(ending(path, None), "trust: options")
    kept(ending(path, None, trust="options"), (130, 0, 0))


@pytest.mark.parametrize("blank", [False, True])
def test_kind_6_a_header_is_not_overruled_by_an_option(path: Path, blank: bool) -> None:
    rates = np.char.mod("%.6f", still())
    if blank:
        rates[0] = ""
    header = "time (s),gx (rad/s),gy (rad/s),gz (rad/s),temp (°C)"
    text(path, header, seconds(6000), rates, np.full(6000, 25.0))
    refused(ending(path, None, columns=[1, 2, 3], units="deg/s"), "rad/s", "deg/s", "trust")
    kept(ending(path, None, columns=[1, 2, 3], units="deg/s", trust="options"))


@pytest.mark.parametrize("unit", ["rad", "deg", "m/s^2", "g", "uT", "Hz", "1/s", "V"])
def test_kind_30_a_unit_of_something_else_is_not_overruled(path: Path, unit: str) -> None:
    text(path, f"t (s),gx ({unit}),gy ({unit}),gz ({unit})", seconds(6000), still())
    refused(ending(path, None, units="deg/s"), re.escape(unit), "trust: options")


@pytest.mark.parametrize(
    ("unit", "dps"), [("rpm", 6.0), ("rev/s", 360.0), ("deg/h", 1 / 3600), ("mrad/s", 0.18 / np.pi)]
)
def test_kind_30_units_of_angular_rate_are_converted(path: Path, unit: str, dps: float) -> None:
    header = f"t (s),gx ({unit}),gy ({unit}),gz ({unit})"
    text(path, header, seconds(6000), still() / dps, digits=9)
    kept(ending(path, None))


def test_kind_30_increments_are_divided_by_their_step(path: Path) -> None:
    text(path, "t (s),gx (rad),gy (rad),gz (rad)", seconds(6000), still() * RAD / 100, digits=9)
    refused(ending(path, None), "increments: true")
    kept(ending(path, None, increments=True))


@pytest.mark.parametrize(
    ("unit", "dps"),
    [("°/sec", 1), ("deg_per_s", 1), ("rad_per_s", 1 / RAD), ("rads/s", 1 / RAD),
     ("millidegrees/s", 1e-3), ("deg·s⁻¹", 1), ("rad s^-1", 1 / RAD), ("dps", 1), ("mdps", 1e-3)],
)  # fmt: skip
def test_kind_14_spellings_of_units_are_read(path: Path, unit: str, dps: float) -> None:
    text(path, f"t (s),gx [{unit}],gy [{unit}],gz [{unit}]", seconds(6000), still() / dps)
    kept(ending(path, None))


def test_kind_16_sensor_logger_needs_the_unit_alone(path: Path) -> None:
    stamps = np.char.mod("%d", 1_700_000_000_000_000_000 + (seconds(6000) * 1e9).astype(int))
    header = "time,seconds_elapsed,z,y,x"
    text(path, header, stamps, seconds(6000), still()[:, ::-1] * RAD)
    refused(ending(path, None), "unit")
    end = ending(path, None, units="rad/s")
    kept(end)
    assert end.rate_hz == pytest.approx(100, rel=1e-3)


def test_kind_17_a_time_unit_that_contradicts_is_refused_unless_trusted(path: Path) -> None:
    text(path, "time (ms),gx (deg/s),gy (deg/s),gz (deg/s)", seconds(6000), still())
    refused(ending(path, time_units="s"), "ms", "trust: options")
    end = ending(path, time_units="s", trust="options")
    kept(end)
    assert end.rate_hz == pytest.approx(100, rel=1e-3)


def test_kind_29_a_scale_named_above_is_not_contradicted_in_silence(path: Path) -> None:
    n, scale = 6000, 0.00106423
    head = "GYROFLOW IMU LOG\nversion,1.3\norientation,YxZ\ntscale,0.001\ngscale,0.00106423\n"
    counts = np.rint(still(n) * RAD / scale)
    text(path, f"{head}t,gx,gy,gz", np.arange(n) * 10, counts)
    end = ending(path, units="deg/s")
    assert end.message, end
    own = ending(path)
    if not own.message:  # the format is known: orientation YxZ is what it applies, or refuses
        assert own.bias is not None
        np.testing.assert_allclose(np.sort(np.abs(own.bias)), np.sort(np.abs(TRUTH)), atol=0.03)


def test_kind_31_browsers_write_z_first(path: Path) -> None:
    header = "t (s),rotationRate.alpha,rotationRate.beta,rotationRate.gamma"
    text(path, header, seconds(6000), still()[:, [2, 0, 1]])
    kept(ending(path, None, units="deg/s"))
    refused(ending(path, None, units="deg/s", columns=[1, 2, 3]), "alpha", "trust")


@pytest.mark.parametrize("bits", [16])
@pytest.mark.parametrize("bias", [(-0.5, -0.9, -0.7), (0.0, -0.9, 0.4)])
def test_kind_26_signed_counts_written_unsigned(
    path: Path, bits: int, bias: Sequence[float]
) -> None:
    scale = 0.00875
    counts = np.rint(still(bias=bias) / scale).astype(int) & (1 << bits) - 1
    text(path, "time (s),gx,gy,gz", seconds(6000), counts)
    options: dict[str, Any] = {"units": "raw", "scale_dps": scale}
    refused(ending(path, None, **options), f"signed_bits: {bits}")
    kept(ending(path, None, **options, signed_bits=bits), bias)


def test_kind_36_lost_decimal_points(path: Path) -> None:
    digits = np.rint(still() * 1e8).astype(int)
    text(path, "t (s);gx (deg/s);gy (deg/s);gz (deg/s)", seconds(6000), digits, sep=";")
    refused(ending(path, None), "decimal point", "export")


def test_kind_37_a_header_in_another_encoding(path: Path) -> None:
    text(path, "t (s),gx,gy,gz", seconds(6000), still())
    rows = path.read_text().split("\n", 1)[1]
    path.write_bytes(
        "时间(s),角速度X(°/s),角速度Y(°/s),角速度Z(°/s)\n".encode("gbk") + rows.encode()
    )
    refused(ending(path, None), "encoding")
    kept(ending(path, None, encoding="gbk"))


def test_kind_39_several_samples_a_row(path: Path) -> None:
    names = [f"{axis}[{k}]" for axis in "xyz" for k in range(8)]
    values = np.concatenate([still(800, (b, b, b))[:, [0] * 8] for b in TRUTH], axis=1)
    header = ",".join(["dt", "scale", "samples", *names])
    text(path, header, np.full(800, 8e4), np.full(800, 1.0), np.full(800, 8), values)
    refused(ending(path, units="deg/s"), "row")
    refused(ending(path, units="deg/s", columns=["x[0]", "y[0]", "z[0]"]), "8 samples")


def test_kind_40_two_sensors_side_by_side(path: Path) -> None:
    names = [f"{chip}_g{axis}" for chip in ("icm", "asm") for axis in "xyz"]
    other = still(bias=(-0.2, 0.3, 0.9), seed=1)
    text(path, ",".join(["t (s)", *names]), seconds(6000), still(), other)
    refused(ending(path, None, units="deg/s"), "icm", "asm", "columns")
    per_imu = ReaderOptions(
        units="deg/s",
        columns={1: ["icm_gx", "icm_gy", "icm_gz"], 2: ["asm_gx", "asm_gy", "asm_gz"]},
    )
    for imu, bias in ((1, TRUTH), (2, (-0.2, 0.3, 0.9))):
        samples = read_log(path, per_imu, None, imu=imu).samples
        np.testing.assert_allclose(samples.mean(axis=0), bias, atol=0.01)


# -- values are samples ----------------------------------------------------------------------


def test_kind_7_rates_in_rad_called_deg_are_kept_with_a_word(path: Path) -> None:
    text(path, "t (s),gx (deg/s),gy (deg/s),gz (deg/s)", seconds(6000), still() * RAD, digits=9)
    kept(ending(path, None), np.array(TRUTH) * RAD, "less noise", "unit")


def test_kind_27_a_dead_band_is_rejected(path: Path) -> None:
    rates = still(bias=(0.04, -0.02, 0.01))
    rates[np.abs(rates) < 0.05] = 0
    text(path, "t (s),gx (deg/s),gy (deg/s),gz (deg/s)", seconds(6000), rates)
    rejected(ending(path, None), "dead band", "0.05")


@pytest.mark.parametrize("every", [2, 4])
def test_kind_28_blank_rates_at_a_regular_share_are_no_samples(path: Path, every: int) -> None:
    n = 12_000
    rates = np.char.mod("%.6f", still(n))
    rates[np.arange(n) % every != 0] = ""
    acceleration = np.random.default_rng(2).normal((0, 0, 1), 0.01, (n, 3))
    header = "t (s),ax (g),ay (g),az (g),gx (deg/s),gy (deg/s),gz (deg/s)"
    text(path, header, seconds(n, 200), acceleration, rates)
    end = ending(path, None)
    kept(end)
    assert end.rate_hz == pytest.approx(200 / every, rel=1e-3)


@pytest.mark.parametrize("settles_s", [2.0, 20.0])
def test_kind_33_a_level_that_goes_to_zero_is_said(path: Path, settles_s: float) -> None:
    rates = still(bias=(0, 0, 0))
    level = np.array([0.3, -0.2, 0.1])
    if settles_s == 2.0:
        rates += level * np.exp(-seconds(6000)[:, None] / 0.6)
    else:
        rates[:2000] += level
    text(path, "t (s),gx (deg/s),gy (deg/s),gz (deg/s)", seconds(6000), rates)
    end = ending(path, None)
    assert re.search("zero|taken off", end.findings), end


@pytest.mark.parametrize("name", ["motionRotationRate{A}(rad/s)", "gyroADC[{a}] (deg/s)"])
def test_kind_33_names_of_rates_freed_of_their_bias(path: Path, name: str) -> None:
    names = [name.format(A=axis, a=number) for number, axis in enumerate("XYZ")]
    text(path, ",".join(["t (s)", *names]), seconds(6000), still(bias=(0, 0, 0)) * RAD, digits=9)
    end = ending(path, None)
    assert re.search("bias", end.findings + end.message, re.IGNORECASE), end


# -- a file is a table, or `row:` makes it so -------------------------------------------------


@pytest.mark.parametrize("header", ["", "t gx gy gz"])
@pytest.mark.parametrize("fmt", ["%.18e", "%10.5f"])
def test_kind_11_savetxt(path: Path, header: str, fmt: str) -> None:
    np.savetxt(path, np.column_stack([seconds(6000), still()]), header=header, fmt=fmt)
    columns = {} if header else {"columns": [1, 2, 3], "time_column": 0}
    kept(ending(path, None, units="deg/s", time_units="s", **columns))


def test_kind_11_sixty_columns(path: Path) -> None:
    table = np.random.default_rng(5).normal(0, 1, (3000, 60))
    table[:, 7:10] = still(3000)
    np.savetxt(path, table)
    kept(ending(path, units="deg/s", columns=[7, 8, 9]))


@pytest.mark.parametrize("between", ["\n", "\n  \n"])
@pytest.mark.parametrize("end", ["", "\n"])
def test_kind_12_blank_lines_and_a_last_line_without_end(
    path: Path, between: str, end: str
) -> None:
    text(path, "t (s),gx (deg/s),gy (deg/s),gz (deg/s)", seconds(3000), still(3000))
    path.write_text(path.read_text().strip().replace("\n", between) + end)
    log = read_log(path, ReaderOptions(), None)
    assert len(log.samples) == 3000
    assert not [f for f in log.findings if f.outcome != "kept"]


def test_kind_15_two_header_rows(path: Path) -> None:
    acceleration = np.random.default_rng(2).normal((0, 0, 1), 0.01, (6000, 3))
    header = "Time (s),IMU Acceleration,,,IMU Gyroscope (rad/s),,\n,X,Y,Z,X,Y,Z"
    text(path, header, seconds(6000), acceleration, still() * RAD, digits=9)
    kept(ending(path, None))


LINES: dict[str, Callable[[float, str, str, str, int], str]] = {
    "vectornav": lambda t, x, y, z, k: f"$VNYMR,+010.1,+001.2,-000.3,{x},{y},{z}*{k % 100:02d}",
    "console": lambda t, x, y, z, k: f"12:{int(t) // 60:02d}:{t % 60:06.3f} -> {x},{y},{z}",
    "tuple": lambda t, x, y, z, k: f"gyro=({x}, {y}, {z})",
    "labels": lambda t, x, y, z, k: f"X: {x}   Y: {y}   Z: {z}",
    "json": lambda t, x, y, z, k: f'{{"t": {t}, "gx": {x}, "gy": {y}, "gz": {z}}}',
    "boot": lambda t, x, y, z, k: f"I ({k}) imu: {x} {y} {z}" if k % 500 else "wifi: connected",
}
ROWS = {
    "vectornav": r"(?P<gx>[-+.\d]+),(?P<gy>[-+.\d]+),(?P<gz>[-+.\d]+)\*",
    "console": r"(?P<time>[\d:.]+) -> (?P<gx>[^,]+),(?P<gy>[^,]+),(?P<gz>[^,]+)",
    "tuple": r"gyro=\((?P<gx>[^,]+), (?P<gy>[^,]+), (?P<gz>[^)]+)\)",
    "labels": r"X: (?P<gx>\S+)\s+Y: (?P<gy>\S+)\s+Z: (?P<gz>\S+)",
    "json": r'"t": (?P<t>[^,]+), "gx": (?P<gx>[^,]+), "gy": (?P<gy>[^,]+), "gz": (?P<gz>[^}]+)}',
    "boot": r"imu: (?P<gx>\S+) (?P<gy>\S+) (?P<gz>\S+)",
}


@pytest.mark.parametrize("kind", LINES)
def test_kind_32_lines_that_are_no_table(path: Path, kind: str) -> None:
    rates = np.char.mod("%+.6f", still()) if kind == "vectornav" else np.char.mod("%.6f", still())
    rows = [LINES[kind](k / RATE, *rates[k].tolist(), k) for k in range(6000)]
    path.write_text("\n".join(rows) + "\n")
    end = ending(path, units="deg/s")
    if end.message:
        assert re.search("row: |row:|columns", end.message), end.message
    else:  # read as a table all the same, and rightly
        kept(end)
    kept(ending(path, units="deg/s", row=ROWS[kind]))


# -- time is told by content ------------------------------------------------------------------


def test_kind_10_steps_of_10_or_20_ms_are_no_change_of_rate(path: Path) -> None:
    for seed in range(5):
        generator = np.random.default_rng(seed)
        steps = generator.choice([0.01, 0.02], 4000) + generator.normal(0, 0.0003, 4000)
        text(path, "t (s),gx (deg/s),gy (deg/s),gz (deg/s)", np.cumsum(steps), still(4000))
        kept(ending(path, None))


def clock(form: str, n: int = 3000) -> list[str]:
    texts = []
    for k in range(n):
        hundredths = 100 * (9 * 3600 + 50 * 60) + k
        h, m = hundredths // 360000, hundredths // 6000 % 60
        s, c = hundredths // 100 % 60, hundredths % 100
        texts.append(form.format(h=h, m=m, s=s, c=c, pm=h + 3, t=k))
    return texts


FORMS = [
    "{m:02d}:{s:02d}.{c:02d}",
    "{h:02d}:{m:02d}:{s:02d}:{c:02d}0",
    "{h:02d}:{m:02d}:{s:02d}.{c:02d}",
    "2023/05/04 {h:02d}:{m:02d}:{s:02d}.{c:02d}0",
    "04.05.2023 {h:02d}:{m:02d}:{s:02d}.{c:02d}",
    "2019-09-27T{h:02d}.{m:02d}.{s:02d}.{c:02d}0",
    "2019-09-27T{h:02d}:{m:02d}:{s:02d}.{c:02d}Z",
    "2019-09-27 {h:02d}:{m:02d}:{s:02d}.{c:02d} UTC",
    "5/4/2023 {h:d}:{m:02d}:{s:02d}.{c:02d} AM",
    "2019-09-27T{h:02d}:{m:02d}:{s:02d}.{c:02d}+02:00",
]


@pytest.mark.parametrize("name", ["timestamp", "date", "Zeit"])
@pytest.mark.parametrize("form", FORMS)
def test_kind_38_times_are_told_by_content(path: Path, form: str, name: str) -> None:
    text(path, f"{name},gx (deg/s),gy (deg/s),gz (deg/s)", clock(form), still(3000))
    end = ending(path)
    kept(end)
    assert end.rate_hz == pytest.approx(100, rel=1e-3), end


@pytest.mark.parametrize(
    ("name", "per_s", "option"),
    [("Time (min)", 1 / 60, None), ("ticks", 1e7, 1e-7), ("ticks", 4e4, 25e-6)],
)
def test_kind_38_minutes_and_ticks(
    path: Path, name: str, per_s: float, option: float | None
) -> None:
    header = f"{name},gx (deg/s),gy (deg/s),gz (deg/s)"
    text(path, header, seconds(6000) * per_s, still(), digits=9)
    options = {} if option is None else {"time_column": name, "time_units": option}
    end = ending(path, **options)
    kept(end)
    assert end.rate_hz == pytest.approx(100, rel=1e-3), end


def test_kind_13_the_first_time_column_that_can_be_parsed(path: Path) -> None:
    names = ",".join(f"{axis}-axis (deg/s)" for axis in "xyz")
    header = f"epoc (ms),timestamp (-0700),elapsed (s),{names}"
    epoch = np.char.mod("%d", 1_569_604_353_000 + 10 * np.arange(3000))
    stamps = clock("2019-09-27T{h:02d}.{m:02d}.{s:02d}.{c:02d}0")
    text(path, header, epoch, stamps, seconds(3000), still(3000))
    end = ending(path, None)
    kept(end)
    assert end.rate_hz == pytest.approx(100, rel=1e-3)


def test_kind_35_steps_since_the_last_row(path: Path) -> None:
    steps = np.random.default_rng(0).normal(10, 0.3, 6000)
    text(path, "dt (ms),gx (deg/s),gy (deg/s),gz (deg/s)", steps, still())
    first = ending(path, None, time_column="dt (ms)")
    assert "time_is: steps" in first.message + first.findings, first
    end = ending(path, None, time_column="dt (ms)", time_is="steps")
    kept(end)
    assert end.rate_hz == pytest.approx(100, rel=1e-2)


# -- thresholds know how much they compare ------------------------------------------------------


@pytest.mark.parametrize(("rate_hz", "hours"), [(10, 1), (5, 2)])
def test_kind_8_long_recordings_of_a_low_rate(path: Path, rate_hz: float, hours: float) -> None:
    n = int(3600 * rate_hz * hours)
    for seed in range(5):
        np.savetxt(path, still(n, seed=seed), header="gx[deg/s] gy[deg/s] gz[deg/s]", fmt="%.5f")
        kept(ending(path, rate_hz))


def test_kind_9_a_knock_of_10_ms_costs_10_ms(path: Path) -> None:
    rates = still(14_450)
    rates[7000, 1] += 0.46
    text(path, "t (s),gx (deg/s),gy (deg/s),gz (deg/s)", seconds(14_450, 120), rates)
    log = read_log(path, ReaderOptions(), 120)
    judged = inspect(log, 120, QUALITY)
    assert (judged.start, judged.stop) == (0, 14_450)
    assert judged.masked[7000] and judged.masked.sum() <= 240
    kept(ending(path, 120))


def test_kind_24_a_drift_that_does_not_settle_is_a_drift(path: Path) -> None:
    rates = still() + np.linspace(0, 0.2, 6000)[:, None]
    text(path, "t (s),gx (deg/s),gy (deg/s),gz (deg/s)", seconds(6000), rates)
    end = ending(path, None)
    kept(end, np.array(TRUTH) + 0.1, "drift")
    assert "warm-up" not in end.findings and "1e+04" not in end.findings, end


def test_kind_34_a_start_of_some_rows_is_cut(path: Path) -> None:
    rates = still(4500, (2, 0.03, 0.3))
    rates[:12, 0] = np.linspace(-0.3, 2, 12)
    text(path, "t (s),gx (deg/s),gy (deg/s),gz (deg/s)", seconds(4500), rates)
    log = read_log(path, ReaderOptions(), None)
    judged = inspect(log, RATE, QUALITY)
    used = np.arange(len(rates))[judged.start : judged.stop][~judged.masked]
    assert used.min() >= 8
    end = ending(path, None)
    kept(end, (2, 0.03, 0.3), within=0.004)
    assert "drift" not in end.findings, end


# -- messages ----------------------------------------------------------------------------------


def test_kind_23_a_large_swing_is_motion(path: Path) -> None:
    rates = still()
    rates[:, 1] += 20 * np.sin(2 * np.pi * seconds(6000) / 3)
    text(path, "t (s),gx (deg/s),gy (deg/s),gz (deg/s)", seconds(6000), rates)
    end = ending(path, None)
    rejected(end, "motion")
    assert "check the unit" not in end.findings


@pytest.mark.parametrize(
    ("name", "content", "word"),
    [
        ("a.rda", b"RDX3\nX\n\x00\x00", "CSV|write"),
        ("b.csv", b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "git lfs pull"),
    ],
)
def test_kind_23_files_that_are_no_logs_get_advice(
    tmp_path: Path, name: str, content: bytes, word: str
) -> None:
    (tmp_path / name).write_bytes(content)
    refused(ending(tmp_path / name), word)


def test_kind_25_accelerations_and_a_temperature_are_kept(path: Path) -> None:
    acceleration = np.random.default_rng(2).normal((0, 0, 9.80665), 0.01, (6000, 3))
    header = "t (s),ax (m/s^2),ay (m/s^2),az (m/s^2),gx (deg/s),gy (deg/s),gz (deg/s),temp (°F)"
    text(path, header, seconds(6000), acceleration, still(), np.full(6000, 77.0))
    log = read_log(path, ReaderOptions(), None)
    assert log.acceleration_g is not None and log.temperature_c is not None
    np.testing.assert_allclose(log.acceleration_g.mean(axis=0), (0, 0, 1), atol=1e-3)
    np.testing.assert_allclose(log.temperature_c, 25, atol=1e-9)
