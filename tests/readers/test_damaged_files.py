"""A corpus of damaged and odd files: each ends as stated, in a recording or in a message.

Each case changes a good file of sixty rows. Refused ones state the message; the others which rows
of the good file come back, which are NaN, and the findings.
"""

import gzip
import io
import re
import zipfile
from dataclasses import dataclass, field

import numpy as np
import pandas as pd
import pytest
import scipy.io

from gyro_pipeline.conventions import InputError

ANGLES, DOT, GENERAL, ARTEMIS = "movella_dot_angles", "movella_dot", "general", "openlog_artemis"


@dataclass(frozen=True)
class Read:
    """A recording: rows of the good file (all, if None), NaN rows in it, findings, gaps."""

    rows: object = None
    nan: tuple = ()
    findings: tuple = ()
    gaps: tuple = ()
    rate_hz: float | None = 120
    options: dict = field(default_factory=dict)


@dataclass(frozen=True)
class Refused:
    message: str
    options: dict = field(default_factory=dict)


def lines(change):
    """A change of the list of lines, the header first."""

    def changed(text):
        return "\n".join(change(text.splitlines())) + "\n"

    return changed


def cell(row, column, text, delimiter=","):
    """Another text in one cell of a data row."""

    def change(all_lines):
        fields = all_lines[row + 1].split(delimiter)
        fields[column] = text
        return [*all_lines[: row + 1], delimiter.join(fields), *all_lines[row + 2 :]]

    return lines(change)


def replaced(*pairs):
    def change(text):
        for old, new in pairs:
            assert old in text
            text = text.replace(old, new)
        return text

    return change


def headers(old, new):
    """Another way of writing the header, the first line."""
    return lines(lambda all_lines: [all_lines[0].replace(old, new), *all_lines[1:]])


def zipped(text):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("log.csv", text)
    return buffer.getvalue()


def workbook(text):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("[Content_Types].xml", "<Types/>")
        archive.writestr("xl/workbook.xml", "<workbook/>")
    return buffer.getvalue()


def in_quotes(text, delimiter=";"):
    return '"' + text.strip().replace(delimiter, f'"{delimiter}"').replace("\n", '"\n"') + '"\n'


def dated(between, zone):
    """Dates in place of the milliseconds."""

    def change(text):
        def date(milliseconds):
            return f"2024-03-01{between}10:00:0{int(milliseconds[1]) / 1000:.2f}{zone};"

        return re.sub(r"(?m)^(\d+);", date, text.replace("t_ms", "time"))

    return change


def joined(all_lines):
    return [*all_lines[:10], all_lines[10][:-1], all_lines[11][1:], *all_lines[12:]]


def no_row(row):
    return lines(lambda all_lines: all_lines[: row + 1] + all_lines[row + 2 :])


def columns_lost(all_lines):
    return all_lines[:31] + [line.rsplit(",", 3)[0] for line in all_lines[31:]]


def parquet(text):
    buffer = io.BytesIO()
    pd.read_csv(io.StringIO(text), skipinitialspace=True).to_parquet(buffer)
    return buffer.getvalue()


def npy(array):
    def saved(text):
        buffer = io.BytesIO()
        np.save(buffer, array, allow_pickle=True)
        return buffer.getvalue()

    return saved


def matlab(at, old, new):
    """A structure of an array, and an array, of MATLAB 5, with other bytes in the former."""

    def saved(text):
        buffer = io.BytesIO()
        scipy.io.savemat(buffer, {"log": {"gyro_dps": np.ones((60, 3))}, "t": np.ones(60)})
        data = buffer.getvalue()
        place = data.index(b"gyro_dps") + at
        assert data[place : place + len(old)] == old
        return data[:place] + new + data[place + len(new) :]

    return saved


RAD = {"units": "rad/s"}
UNIT = ("unit", "kept")  # of the format
UNREADABLE = ("unreadable rows", "repaired")
CUT = ("end of file", "repaired")
BACK = ("time order", "repaired")
BUT_LAST = slice(0, 59)

CASES = {
    # text that is odd, but safe to read
    "as it is": (ANGLES, lambda text: text, Read()),
    "byte order mark": (ANGLES, lambda text: text.encode("utf-8-sig"), Read()),
    "UTF-16": (ANGLES, lambda text: text.encode("utf-16"), Read()),
    "UTF-16, the other way": (ANGLES, lambda t: b"\xfe\xff" + t.encode("utf-16-be"), Read()),
    "CR LF": (ANGLES, replaced(("\n", "\r\n")), Read()),
    "CR only": (ANGLES, replaced(("\n", "\r")), Read()),
    "blank lines": (ANGLES, replaced(("\n", "\n\n")), Read()),
    "quoted fields": (
        GENERAL,
        in_quotes,
        Read(rate_hz=100),
    ),
    "tabs": (GENERAL, replaced((";", "\t")), Read(rate_hz=100)),
    "decimal commas": (GENERAL, replaced((".", ",")), Read(rate_hz=100)),
    "decimal commas and tabs": (GENERAL, replaced((".", ","), (";", "\t")), Read(rate_hz=100)),
    "another encoding of the degree sign": (
        GENERAL,
        lambda t: t.encode("cp1252"),
        Read(rate_hz=100),
    ),
    "no trailing delimiter in the header": (ANGLES, headers("w_z,", "w_z"), Read()),
    "a header that is a comment": (GENERAL, lambda text: f"# {text}", Read(rate_hz=100)),
    "sep line": (ANGLES, lambda text: f"sep=,\n{text}", Read()),
    "sep line of another delimiter": (
        ANGLES,
        lambda text: f"sep=;\n{text}",
        Refused("separated by ;, got none"),
    ),
    "an enormous field that is not needed": (ANGLES, cell(20, 4, "7" * 3_000_000), Read()),
    "dates for times": (GENERAL, dated("T", ""), Read(rate_hz=100)),
    "dates for times in UTC, one of them unreadable": (
        GENERAL,
        lambda t: cell(9, 0, "2024-03-0x", ";")(dated(" ", "Z")(t)),
        Read(rate_hz=100, findings=(UNREADABLE,)),
    ),
    "a clock time unreadable": (
        ARTEMIS,
        cell(9, 1, "12:xx"),
        Read(rate_hz=100, findings=(("unreadable rows", "repaired"),)),
    ),
    "NaN and infinity in words": (
        ANGLES,
        lambda t: cell(9, 7, " NaN")(cell(7, 8, "-Infinity")(t)),
        Read(nan=(7, 9)),
    ),
    "an empty field": (ANGLES, cell(9, 7, ""), Read(nan=(9,))),
    # damage that is repaired, and said
    "the last line is cut between fields": (
        ANGLES,
        lambda t: t[:-20],
        Read(BUT_LAST, findings=(CUT,)),
    ),
    "the last line is cut within its last number": (
        GENERAL,
        lambda t: t[:-4],
        Read(BUT_LAST, findings=(CUT,), rate_hz=100),
    ),
    "the last line lacks its line end only": (ANGLES, lambda t: t[:-1], Read()),
    "zero bytes at the end, as of a card": (
        ANGLES,
        lambda t: t.encode() + bytes(4096),
        Read(findings=(CUT,)),
    ),
    "the last line is cut, fields are quoted": (
        GENERAL,
        lambda t: in_quotes(t)[:-6],
        Read(BUT_LAST, findings=(CUT,), rate_hz=100),
    ),
    "text in a number column": (
        ANGLES,
        cell(9, 8, "error"),
        Read(nan=(9,), findings=(UNREADABLE,)),
    ),
    "an enormous field": (
        ANGLES,
        cell(9, 8, "x" * 200_000),
        Read(nan=(9,), findings=(UNREADABLE,)),
    ),
    "a field too many in two rows": (
        ANGLES,
        lambda t: cell(9, 8, "1,2")(cell(30, 2, "1,2")(t)),
        Read(nan=(9, 30), findings=(UNREADABLE,)),
    ),
    "a message of the logger between rows": (
        ANGLES,
        lines(lambda all_lines: [*all_lines[:31], "SD card slow", *all_lines[31:]]),
        Read([*range(30), -1, *range(30, 60)], nan=(30,), findings=(UNREADABLE,)),
    ),
    "bytes that are no text": (
        ANGLES,
        lambda t: cell(9, 8, "@@@@")(t).encode().replace(b"@@@@", b"\xff\x00\xfe\x01"),
        Read(nan=(9,), findings=(UNREADABLE,)),
    ),
    "an open quote": (ANGLES, cell(9, 4, '"'), Read()),
    # time
    "a row is missing": (
        ANGLES,
        no_row(30),
        Read([*range(30), *range(31, 60)], findings=(("gaps", "repaired"),), gaps=(30,)),
    ),
    "a packet is missing, time is smooth": (
        DOT,
        lines(
            lambda t: (
                t[:30]
                + [f"{int(line.split(',')[0]) + 1},{line.split(',', 1)[1]}" for line in t[30:]]
            )
        ),
        Read(findings=(("packet counter", "repaired"),), gaps=(25,), rate_hz=120.0048),
    ),
    "a row is twice": (
        ANGLES,
        lines(lambda t: [*t[:31], *t[30:]]),
        Read([*range(30), *range(29, 60)], findings=(("duplicated timestamps", "kept"),)),
    ),
    "time goes back: concatenated without header": (
        ANGLES,
        lambda t: t + t.split("\n", 1)[1],
        Read([*range(60), *range(60)], findings=(BACK,), gaps=(60,)),
    ),
    "two rows are swapped": (
        ANGLES,
        lines(lambda t: [*t[:30], t[31], t[30], *t[32:]]),
        Read(
            [*range(29), 30, 29, *range(31, 60)],
            findings=(BACK, ("gaps", "repaired")),
            gaps=(29, 30, 31),
        ),
    ),
    "midnight": (
        ARTEMIS,
        replaced(("11:59:59", "23:59:59"), ("12:00:00", "00:00:00")),
        Read(findings=(("wrap-around", "kept"),), rate_hz=100),
    ),
    "milliseconds under a header of seconds": (
        ANGLES,
        headers("Time", "Time (ms)"),
        Read(findings=(("sample rate", "rejected"),), rate_hz=120_000),
    ),
    "time without a unit": (
        GENERAL,
        headers("t_ms", "t"),
        Read(findings=(("timestamps", "kept"),), rate_hz=None),
    ),
    "time with an unknown unit": (
        GENERAL,
        headers("t_ms", "t (h)"),
        Refused("expected a time in s"),
    ),
    # what cannot be read safely
    "empty": (ANGLES, lambda text: "", Refused("got an empty file")),
    "blank": (ANGLES, lambda text: "\n\n \n", Refused("expected a header and rows of three")),
    "header only": (
        ANGLES,
        lambda t: t.split("\n", 1)[0] + "\n",
        Refused("got none in the first 1"),
    ),
    "one row": (ANGLES, lines(lambda t: t[:2]), Refused("got one only")),
    "half a row": (ANGLES, lambda t: t[:90], Refused("as many columns as the rows, 9, got 11")),
    "one row and no line end": (
        GENERAL,
        lambda t: "\n".join(t.split("\n", 2)[:2]),
        Refused("got none but a cut one"),
    ),
    "binary junk": (
        ANGLES,
        lambda t: np.random.default_rng(1).bytes(5000),
        Refused("expected a header and rows"),
    ),
    "binary zeros": (ANGLES, lambda t: bytes(range(4)) * 99, Refused("got binary data")),
    "junk without zeros": (
        ANGLES,
        lambda t: bytes(range(1, 256)) * 20,
        Refused("expected a header and rows"),
    ),
    "UTF-16 without byte order mark": (
        ANGLES,
        lambda t: t.encode("utf-16-le"),
        Refused("UTF-16 without byte order mark"),
    ),
    "gzip": (ANGLES, lambda t: gzip.compress(t.encode()), Refused("a gzip archive; unpack it")),
    "zip": (ANGLES, zipped, Refused("a zip archive; unpack it")),
    "Excel": (ANGLES, workbook, Refused("an Excel workbook")),
    "old Excel": (ANGLES, lambda t: b"\xd0\xcf\x11\xe0" + bytes(600), Refused("an Excel workbook")),
    "half a zip": (ANGLES, lambda t: zipped(t)[:2000], Refused("it is damaged, copy it anew")),
    "half a Parquet file": (ANGLES, lambda t: parquet(t)[:2000], Refused("copy it anew")),
    "an npy file cut": (ANGLES, lambda t: npy(np.ones((50, 3)))(t)[:400], Refused("copy it anew")),
    "an npy file of pickles": (ANGLES, npy(np.array([{}], object)), Refused("got Python objects")),
    "an npy file of one column": (ANGLES, npy(np.ones(50)), Refused(r"expected shape \(n, 3\)")),
    "an npy file transposed": (ANGLES, npy(np.ones((6, 50))), Refused("with a row a sample")),
    # SciPy would end the process, or fill the memory
    "a MATLAB file with data of no type": (
        ANGLES,
        matlab(64, b"\x09\0\0\0\xa0\x05\0\0", b"\x09\x38"),
        Refused("data of type 14345 and 1440 bytes; it is damaged"),
    ),
    "a MATLAB file with an array of no class": (
        ANGLES,
        matlab(32, b"\x06\0\0\0", b"\x60"),
        Refused("an array of class 96"),
    ),
    "a MATLAB file with an array larger than it": (
        ANGLES,
        matlab(48, b"\x3c\0\0\0\x03\0\0\0", b"\x3c\0\0\x40"),
        Refused(r"an array of \(1073741884, 3\) in"),
    ),
    "a MATLAB file with an array larger than it, in unsigned numbers": (
        ANGLES,
        matlab(40, b"\5\0\0\0\x08\0\0\0\x3c\0\0\0", b"\6\0\0\0\x08\0\0\0\x3c\0\0\x40"),
        Refused(r"an array of \(1073741884, 3\) in"),
    ),
    "a MATLAB file with a size of the class that is not one": (
        ANGLES,
        matlab(28, b"\x08\0\0\0", b"\x18"),
        Refused("an array without a class"),
    ),
    "a MATLAB file with an array of reals called complex": (
        ANGLES,
        matlab(32, b"\6\0", b"\6\x08"),
        Refused(r"an array of class 6 of data of types \[6, 5, 1, 9\]"),
    ),
    "a MATLAB file with a full array called sparse": (
        ANGLES,
        matlab(32, b"\6\0", b"\5"),
        Refused(r"an array of class 5 of data of types \[6, 5, 1, 9\]"),
    ),
    "a MATLAB file with an array whose name takes in its values": (
        ANGLES,
        matlab(56, b"\1\0\0\0\0\0\0\0", b"\1\0\0\0\xa8\5"),
        Refused(r"an array of class 6 of data of types \[6, 5, 1\]"),
    ),
    "another delimiter": (
        ANGLES,
        replaced((",", "|")),
        Refused("separated by comma, semicolon or tab, got none"),
    ),
    "another number of columns from a row on": (
        ANGLES,
        lines(columns_lost),
        Refused("got 30 of 60 that are not: row 30 .line 32."),
    ),
    "a comma too many in the header": (
        ARTEMIS,
        lambda text: f",{text}",
        Refused("as many columns as the rows, 14, got 15"),
    ),
    "a comma too many in a header that rows outdo by one": (
        ANGLES,
        headers("psi,f_x,f_y,f_z,w_x,w_y,w_z,", "psi,,f_x,f_y,f_z,w_x,w_y,w_z"),
        Refused("as many columns as the rows, 11, got 11"),
    ),
    "a header of fewer columns": (
        ANGLES,
        headers("phi,theta,", ""),
        Refused("as many columns as the rows, 11, got 9"),
    ),
    "text in every row": (
        ANGLES,
        lines(lambda t: [t[0], *[line.replace(",-0.93,", ",x,") for line in t[1:]]]),
        Refused("got 60 of 60", {"columns": ("phi", "w_x", "w_y")}),
    ),
    "two recordings, each with its header": (
        ANGLES,
        lambda t: t + t,
        Refused("line 62 .row 60.: expected numbers, got a second header"),
    ),
    "two loggers' files in one": (
        ANGLES,
        lambda t: t + t.replace("w_x", "x").replace("w_y", "y"),
        Refused("a second header"),
    ),
    "two recordings, each with its sep line": (
        DOT,
        lambda t: t + t,
        Refused("line 66 .row 60.: expected numbers, got a second header"),
    ),
    "two sensors side by side": (
        ANGLES,
        headers("f_x,f_y,f_z", "w_x,w_y,w_z"),
        Refused(r"one column 'w_x', got 2, numbers 4, 7", {"format": ANGLES}),
    ),
    "two sensors side by side, told by numbers": (
        ANGLES,
        headers("f_x,f_y,f_z", "w_x,w_y,w_z"),
        Read(options={"columns": (7, 8, 9), "units": "deg/s", "time_units": "s"}),
    ),
    "a missing column": (
        ANGLES,
        headers("w_y", "wy"),
        Refused("expected a column 'w_y', got 'Time', ", {"format": ANGLES}),
    ),
    "no unit": (
        GENERAL,
        replaced((" [rad/s]", "")),
        Refused("expected three columns of angular rate"),
    ),
    "no unit, columns named": (
        GENERAL,
        replaced((" [rad/s]", "")),
        Refused("expected a unit of the rates", {"columns": ("gx", "gy", "gz")}),
    ),
    "no unit, given": (
        GENERAL,
        replaced((" [rad/s]", "")),
        Read(rate_hz=100, options={"columns": ("gx", "gy", "gz"), **RAD}),
    ),
    "units that contradict each other": (
        GENERAL,
        headers("gy [rad/s]", "gy [deg/s]"),
        Refused("expected one unit of all rates"),
    ),
    "a unit on one axis only": (
        GENERAL,
        headers("gy [rad/s]", "gy"),
        Refused("expected one unit of all rates", {"columns": ("gx", "gy", "gz")}),
    ),
    "units that contradict the options": (
        GENERAL,
        lambda t: t,
        Refused("the header says rad/s", {"units": "deg/s"}),
    ),
    "thousands separators": (
        GENERAL,
        replaced((";0.0", ";1,000.0")),
        Refused("numbers with both commas and points"),
    ),
    "commas that may separate thousands": (
        "three columns",
        lambda t: "x;y;z\n" + "1,024;2,048;-3,072\n" * 9,
        Refused("a comma before three"),
    ),
    "quoted thousands separators": (
        ANGLES,
        lambda t: cell(9, 8, '"1,234.5"')(in_quotes(t, ",")),
        Refused("numbers without thousands separators, got '1,234.5'"),
    ),
    "a quoted field over two lines": (
        GENERAL,
        lambda t: lines(joined)(in_quotes(t)),
        Refused("a quoted field does not end"),
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_a_damaged_file_ends_as_stated(case, good, rates, read):
    name, change, outcome = CASES[case]
    content = change(good.get(name, ""))
    if isinstance(outcome, Refused):
        with pytest.raises(InputError, match=outcome.message) as error:
            read(content, **outcome.options)
        assert "log.csv" in str(error.value)
        return
    log = read(content, 120 if name == ANGLES else None, **outcome.options)
    expected = rates if outcome.rows is None else rates[outcome.rows]
    whole = np.delete(np.arange(len(expected)), list(outcome.nan))
    assert len(log.samples) == len(expected)
    np.testing.assert_allclose(log.samples[whole], expected[whole], rtol=0, atol=1e-7)
    assert (~np.isfinite(log.samples[list(outcome.nan)])).any(axis=1).all()
    found = [(f.check, f.outcome) for f in log.findings]
    assert [one for one in found if one != UNIT] == list(outcome.findings)
    assert found.count(UNIT) == (name != GENERAL and "units" not in outcome.options)
    assert log.gap_rows.tolist() == list(outcome.gaps)
    if outcome.rate_hz is None:
        assert log.rate_hz is None
    else:
        assert log.rate_hz == pytest.approx(outcome.rate_hz, rel=1e-5)


def test_the_corpus_is_large_enough():
    assert len(CASES) >= 25


def test_a_missing_file_and_a_folder_are_refused(tmp_path, read):
    with pytest.raises(InputError, match="cannot be read: No such file"):
        read(lambda path: None)
    with pytest.raises(InputError, match="cannot be read: Is a directory"):
        read(lambda path: path.mkdir())


@pytest.mark.parametrize(("rows", "most"), [(100, 3), (400, 4), (1000, 10)])
def test_one_row_in_a_hundred_may_be_unreadable_but_no_more(rows, most, read):
    good = ["x_dps,y_dps,z_dps", *["1,2,3"] * rows]
    broken = [*good[: rows - most], *["1,2"] * most, "4,5,6"]
    log = read("\n".join(broken) + "\n")
    assert np.isnan(log.samples).all(axis=1).sum() == most
    assert log.samples[-1].tolist() == [4, 5, 6]
    with pytest.raises(InputError, match=f"got {most + 1} of {rows} that are not"):
        read("\n".join([*broken[:-1], "1,2"]) + "\n")


def test_a_finding_says_which_row_and_line_and_why(good, read):
    text = cell(9, 8, "error")(good[ANGLES])
    for content, line in ((text, 11), (text.replace("\n", "\n\n"), 21)):
        finding, _ = read(content, 120).findings
        assert finding.detail == (
            f"1 of 60 rows cannot be read and are NaN: row 9 (line {line}): w_y: expected a "
            "number, got 'error'"
        )
