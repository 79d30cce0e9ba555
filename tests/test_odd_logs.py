"""Logs that once gave a silent wrong number, or were lost: how each kind ends now.

A kind is written as a file, read, and judged. It either ends in a message that names what to do, or
is kept with the right bias. Values are invented; the kinds come from public logs and reports.
"""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import yaml

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
N = 6000


class Refused(NamedTuple):
    """A file that is refused with these words, in this order."""

    words: str


class Rejected(NamedTuple):
    """A file that is read, but whose recording is rejected with these words."""

    words: str


class Kept(NamedTuple):
    """A recording that is kept, its bias and rate, and words of its findings."""

    bias: tuple[float, ...] = TRUTH
    words: str = ""
    rate_hz: float | None = None
    within: float = 0.01


def check(path, ending, **options):
    """Read and judge a file, and compare how it ends."""
    try:
        log = read_log(path, ReaderOptions(**options))
    except InputError as error:
        assert isinstance(ending, Refused) and re.search(f"(?i){ending.words}", str(error)), error
        return
    judged = inspect(log, log.rate_hz or RATE, QUALITY)
    findings = "; ".join(f"{finding.check}: {finding.detail}" for finding in judged.findings)
    assert not isinstance(ending, Refused), findings
    assert (judged.outcome == REJECTED) == isinstance(ending, Rejected), findings
    assert re.search(f"(?i){ending.words}", findings), findings
    if isinstance(ending, Kept):
        samples = log.samples[judged.start : judged.stop][~judged.masked]
        np.testing.assert_allclose(samples.mean(axis=0), ending.bias, atol=ending.within)
        assert ending.rate_hz is None or log.rate_hz == pytest.approx(ending.rate_hz, rel=1e-2)


def still(bias=TRUTH):
    return np.random.default_rng(0).normal(bias, 0.05, (N, 3))


def text(path, header, columns):
    """A text of a header and columns: numbers, or texts."""
    cells = [
        vector.tolist() if vector.dtype.kind in "UO" else np.char.mod("%.9f", vector)
        for block in columns
        for vector in np.atleast_2d(np.asarray(block).T)
    ]
    path.write_text("\n".join([header, *map(",".join, zip(*cells, strict=True))]) + "\n")


def blank(rates, rows):
    return np.where(rows[:, None], "", np.char.mod("%.6f", rates))


K, S, X = np.arange(N), np.arange(N) / RATE, still()
ACC = np.random.default_rng(2).normal((0, 0, 9.80665), 0.01, (N, 3))
T, G = "time (s)", "gx (deg/s),gy (deg/s),gz (deg/s)"
DEG, TRUSTED = {"units": "deg/s"}, {"trust": "options"}
BY_NUMBER = DEG | {"columns": [1, 2, 3]}
RAW = {"units": "raw", "scale_dps": 0.01}
STAMPS = np.char.mod("%d", 1_700_000_000_000_000_000 + (S * 1e9).astype(int))
ARRAYS = ",".join(["dt,scale,samples", *(f"{axis}[{k}]" for axis in "xyz" for k in range(8))])
SWITCH = 0.01 * np.random.default_rng(0).choice([1, 2], N)
FLAGS = "temp (degC),sync,hundredths,status"
WARMTH = 25 + 0.1 * np.random.default_rng(0).integers(0, 2, N)
SWING = X + [0, 20, 0] * np.sin(2 * np.pi * S / 3)[:, None]
LEVEL = np.array([0.3, -0.2, 0.1])
FREED = still(bias=(0, 0, 0))
STEPS = np.random.default_rng(0).normal(10, 0.3, N)
RAMP = still((2, 0.03, 0.3))
RAMP[:12, 0] = np.linspace(-0.3, 2, 12)

KINDS = {  # a header, columns, and how it ends with some options
    "1 columns that say nothing of a row": (f"{T},{FLAGS},{G}",
        [S, WARMTH, K % 10 == 0, K % 100, K * 0 + 1, X], [({}, Kept())]),
    "3 samples written ten times": (f"{T},{G}",
        [np.arange(10 * N) / 1000, np.repeat(X, 10, axis=0)],
        [({}, Rejected(r"90(\.0)?%.*repeats: drop")), ({"repeats": "drop"}, Kept(rate_hz=100))]),
    **{f"4 no rates {names}": (f"{T},{names}", [S, X],
        [(DEG, Refused("columns|rate")), (BY_NUMBER, Refused(f"{names[:2]}.*trust"))])
       for names in ("ax,ay,az", "roll,pitch,yaw")},
    "5 counts about an offset": (f"{T},gx,gy,gz", [S, np.rint(32768 + X / 0.01)],
        [(RAW, Refused("offset")), (RAW | {"offset": 32768}, Kept())]),
    "5 a level of 130 deg/s": (f"{T},{G}", [S, X + 130],
        [({}, Refused("trust: options")), (TRUSTED, Kept(np.array(TRUTH) + 130))]),
    "7 rad/s called deg/s": (f"{T},{G}", [S, X * RAD],
        [({}, Kept(np.array(TRUTH) * RAD, "less noise.*unit"))]),
    "10 steps of 10 or 20 ms": (f"{T},{G}", [np.cumsum(SWITCH + STEPS * 3e-5), X], [({}, Kept())]),
    "16 Sensor Logger": ("time,seconds_elapsed,z,y,x", [STAMPS, S, X[:, ::-1] * RAD],
        [({}, Refused("unit")), ({"units": "rad/s"}, Kept(rate_hz=100))]),
    "23 a large swing": (f"{T},{G}", [S, SWING], [({}, Rejected("^(?!.*check the unit).*motion"))]),
    **{f"28 blank but in {k}": (f"{T},ax (g),ay (g),az (g),{G}", [S / 2, ACC, blank(X, K % k > 0)],
        [({}, Kept(rate_hz=200 / k))]) for k in (2, 4)},
    **{f"30 a unit of something else {unit}": (f"{T},gx ({unit}),gy ({unit}),gz ({unit})", [S, X],
        [(DEG, Refused(f"{re.escape(unit)}.*trust: options"))])
       for unit in ("rad", "m/s^2", "1/s")},
    **{f"14, 30 {unit}": (f"{T},gx [{unit}],gy [{unit}],gz [{unit}]", [S, X / dps], [({}, Kept())])
       for unit, dps in {"rpm": 6, "deg/h": 1 / 3600, "mrad/s": RAD**-1 / 1e3, "°/sec": 1,
                         "rad s^-1": 1 / RAD, "mdps": 1e-3}.items()},
    "33 a level that settles to zero": (f"{T},{G}", [S, FREED + LEVEL * np.exp(-S / 0.6)[:, None]],
        [({}, Rejected("subtracts its bias"))]),
    "33 a name of Core Motion": (",".join([T, *(f"motionRotationRate{a}(rad/s)" for a in "XYZ")]),
        [S, FREED * RAD], [({}, Kept((0, 0, 0), "bias"))]),
    "34 a start of some rows": (f"{T},{G}", [S, RAMP],
        [({}, Kept((2, 0.03, 0.3), "^(?!.*drift)start: .*rows 0 to 59 ", within=0.004))]),
    "36 lost decimal points": (f"{T},{G}", [S, np.rint(X * 1e8)],
        [({}, Refused("decimal point.*export"))]),
    **{f"38 ticks of {tick}": (f"ticks,{G}", [S / tick, X],
        [({"time_column": "ticks", "time_units": tick}, Kept(rate_hz=100))])
       for tick in (1e-7, 25e-6)},
    "39 eight samples a row": (ARRAYS, [K[:800], S[:800] * 0 + 1, S[:800] * 0 + 8,
                                        np.repeat(X[:800], 8, axis=1)],
        [(DEG, Refused("row")),
         (DEG | {"columns": ["x[0]", "y[0]", "z[0]"]}, Refused("8 samples"))]),
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_each_kind_ends_in_advice_or_with_the_right_bias(tmp_path, kind):
    header, columns, endings = KINDS[kind]
    text(tmp_path / "log.csv", header, columns)
    for options, ending in endings:
        check(tmp_path / "log.csv", ending, **options)
