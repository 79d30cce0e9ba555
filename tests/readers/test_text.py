"""Delimited texts, odd and damaged ones: each is the table that it should be, or a message."""

import io
import os
import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from gyro_pipeline.conventions import InputError
from gyro_pipeline.parameters import ReaderOptions
from gyro_pipeline.readers.table import read_table

ANGLES, DOT, GENERAL = "movella_dot_angles", "movella_dot", "general"
RATES = {
    ANGLES: ("w_x", "w_y", "w_z"),
    DOT: ("Gyr_X", "Gyr_Y", "Gyr_Z"),
    GENERAL: ("gx [rad/s]", "gy [rad/s]", "gz [rad/s]"),
}


@dataclass(frozen=True)
class Read:
    """Rows of the good file that come back (all, if None), NaN rows in them, and findings."""

    rows: object = None
    nan: tuple = ()
    findings: tuple = ()
    options: dict = field(default_factory=dict)


@dataclass(frozen=True)
class Refused:
    message: str


def lines(change):
    """A change of the list of lines, the header first."""
    return lambda text: "\n".join(change(text.splitlines())) + "\n"


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


def inserted(at, *new):
    return lines(lambda all_lines: [*all_lines[:at], *new, *all_lines[at:]])


def header(old, new):
    return lines(lambda all_lines: [all_lines[0].replace(old, new), *all_lines[1:]])


def in_quotes(text, delimiter=";"):
    return '"' + text.strip().replace(delimiter, f'"{delimiter}"').replace("\n", '"\n"') + '"\n'


def joined(all_lines):
    return [*all_lines[:10], all_lines[10][:-1], all_lines[11][1:], *all_lines[12:]]


CUT, ROWS, CELLS = "end of file", "unreadable rows", "unreadable cells"
BUT_LAST = slice(0, 59)
CASES = {
    # odd, but whole
    "as it is": (ANGLES, lambda t: t, Read()),
    "byte order mark": (ANGLES, lambda t: t.encode("utf-8-sig"), Read()),
    "UTF-16": (ANGLES, lambda t: t.encode("utf-16"), Read()),
    "UTF-16, the other way": (ANGLES, lambda t: b"\xfe\xff" + t.encode("utf-16-be"), Read()),
    "UTF-16 without mark, told": (
        ANGLES,
        lambda t: t.encode("utf-16-le"),
        Read(options={"encoding": "utf-16-le"}),
    ),
    "CR LF": (ANGLES, replaced(("\n", "\r\n")), Read()),
    "CR only": (ANGLES, replaced(("\n", "\r")), Read()),
    "blank lines": (ANGLES, replaced(("\n", "\n\n")), Read()),
    "lines of two blanks": (ANGLES, replaced(("\n", "\n  \n")), Read()),
    "lines of two blanks and no line end": (
        ANGLES, lambda t: t.replace("\n", "\n  \n")[:-4], Read()),
    "no line end after the last row": (GENERAL, lambda t: t[:-1], Read()),
    "quoted fields": (GENERAL, in_quotes, Read()),
    "tabs": (GENERAL, replaced((";", "\t")), Read()),
    "decimal commas": (GENERAL, replaced((".", ",")), Read()),
    "decimal commas and tabs": (GENERAL, replaced((".", ","), (";", "\t")), Read()),
    "commas in texts, which say nothing of decimals": (
        GENERAL,
        lambda t: "\n".join(f"{line};Sun, 31" for line in t.splitlines()),
        Read(),
    ),
    "another delimiter, told": (
        ANGLES,
        lambda t: t.replace(", \n", "\n").replace("w_z,", "w_z").replace(",", "|"),
        Read(options={"delimiter": "|"}),
    ),
    "a degree sign in another encoding": (GENERAL, lambda t: t.encode("cp1252"), Read()),
    "no trailing delimiter in the header": (ANGLES, header("w_z,", "w_z"), Read()),
    "a header that is a comment": (GENERAL, lambda t: f"# {t}", Read()),
    "lines between header and rows": (GENERAL, inserted(1, "", "started; at noon", "# 1"), Read()),
    "a sep line": (ANGLES, lambda t: f"sep=,\n{t}", Read()),
    "an enormous field elsewhere": (ANGLES, cell(20, 4, "7" * 3_000_000), Read()),
    "an open quote elsewhere": (ANGLES, cell(9, 4, '"'), Read(findings=(CELLS,))),
    "words for NaN and infinity": (
        ANGLES,
        lambda t: cell(9, 7, " NaN")(cell(7, 8, "-Infinity")(t)),
        Read(nan=(7, 9)),
    ),
    "an empty field": (ANGLES, cell(9, 7, ""), Read(nan=(9,))),
    "first rates empty": (GENERAL, replaced(("\n0;25.000;", "\n0;25.000;;;\n0;25.000;")),
                          Read([-1, *range(60)], nan=(0,))),
    "comments among the rows": (
        ANGLES,
        inserted(20, "# a marker", "  // and another", "# so,1,2,3,4,5,6,7,8,9,"),
        Read(findings=("comments",)),
    ),
    # damage that is said
    "the last line cut between fields": (ANGLES, lambda t: t[:-20], Read(BUT_LAST, (), (CUT,))),
    "the last line cut, in quotes": (
        GENERAL, lambda t: in_quotes(t)[:-16], Read(BUT_LAST, (), (CUT,))),
    "zeros of a card at the end": (
        ANGLES, lambda t: t.encode() + bytes(4096), Read((), (), (CUT,))),
    "text in a number column": (ANGLES, cell(9, 8, "error"), Read(None, (9,), (CELLS,))),
    "an enormous field": (ANGLES, cell(9, 8, "x" * 200_000), Read(None, (9,), (CELLS,))),
    "a field too many in two rows": (
        ANGLES,
        lambda t: cell(9, 8, "1,2")(cell(30, 2, "1,2")(t)),
        Read(None, (9, 30), (ROWS,)),
    ),
    "a field too many in the first row": (ANGLES, cell(0, 2, "1,2"), Read(None, (0,), (ROWS,))),
    "a message between rows": (
        ANGLES,
        inserted(31, "SD card slow"),
        Read([*range(30), -1, *range(30, 60)], (30,), (ROWS,)),
    ),
    "bytes that are no text": (
        ANGLES,
        lambda t: cell(9, 8, "@@@@")(t).encode().replace(b"@@@@", b"\xff\x00\xfe\x01"),
        Read(None, (9,), (CELLS,)),
    ),
    # what cannot be read safely
    "empty": (ANGLES, lambda t: "", Refused("got an empty file")),
    "blank": (ANGLES, lambda t: "\n\n \n", Refused("expected two rows or more")),
    "one row": (ANGLES, lines(lambda t: t[:2]), Refused("got none in the first 2 lines")),
    "a sep line of another delimiter": (
        ANGLES, lambda t: f"sep=;\n{t}", Refused("separated by semicolon, got none")),
    "binary junk": (
        ANGLES, lambda t: np.random.default_rng(1).bytes(5000), Refused("expected two rows")),
    "binary zeros": (ANGLES, lambda t: bytes(range(4)) * 99, Refused("got binary data")),
    "UTF-16 without mark": (
        ANGLES, lambda t: t.encode("utf-16-le"), Refused("`encoding: utf-16-le`")),
    "another delimiter": (ANGLES, replaced((",", "|")), Refused("or tab or blanks, got none")),
    "fewer columns from a row on": (
        ANGLES,
        lines(lambda t: t[:31] + [line.rsplit(",", 3)[0] for line in t[31:]]),
        Refused("got 30 of 60 that are not: row 30 .line 32."),
    ),
    "a comma too many before the header": (
        ANGLES, lambda t: f",{t}", Refused("as many columns as the rows, 11, got 12")),
    "a comma too many in a header without the last": (
        ANGLES,
        header("psi,f_x,f_y,f_z,w_x,w_y,w_z,", "psi,,f_x,f_y,f_z,w_x,w_y,w_z"),
        Refused("as many columns as the rows, 11, got 11"),
    ),
    "a header of fewer columns": (
        ANGLES, header("phi,theta,", ""), Refused("columns as the rows, 11, got 9")),
    "two recordings": (ANGLES, lambda t: t + t, Refused("a second header in row 60 .line 62.")),
    "two loggers": (ANGLES, lambda t: t + t.replace("w_", ""), Refused("a second header")),
    "two recordings with sep lines": (
        DOT, lambda t: t + t, Refused("a second header in row 60 .line 66.")),
    "thousands and decimals": (
        GENERAL, replaced((";0.0", ";1,000.0")), Refused("with both commas and points")),
    "what may be thousands": (
        GENERAL, lambda t: "x;y;z\n" + "1,024;2,048;-3,072\n" * 9, Refused("a comma before three")),
    "a quoted field over two lines": (
        GENERAL, lambda t: lines(joined)(in_quotes(t)), Refused("a quoted field does not end")),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_an_odd_or_damaged_text_ends_as_stated(case, good, rates, table):
    logger, change, outcome = CASES[case]
    content = change(good[logger])
    if isinstance(outcome, Refused):
        with pytest.raises(InputError, match=outcome.message) as error:
            table(content)
        assert "log.csv" in str(error.value)
        return
    log = table(content, **outcome.options)
    samples = np.stack([log.numbers(log.names.index(name)) for name in RATES[logger]], axis=1)
    samples = np.degrees(samples) if logger == GENERAL else samples
    rows = range(60)[outcome.rows] if isinstance(outcome.rows, slice) else outcome.rows
    expected = rates[list(rows or range(60))]
    assert len(samples) == len(expected)
    whole = np.delete(np.arange(len(expected)), list(outcome.nan))
    np.testing.assert_allclose(samples[whole], expected[whole], rtol=0, atol=1e-7)
    assert (~np.isfinite(samples[list(outcome.nan)])).any(axis=1).all()
    assert [finding.check for finding in log.findings] == list(outcome.findings)


def saved(columns, **options):
    buffer = io.BytesIO()
    values = np.random.default_rng(0).normal(size=(30, columns))
    np.savetxt(buffer, values, **options)
    return buffer.getvalue(), values


@pytest.mark.parametrize("columns", [3, 4, 60])
@pytest.mark.parametrize("options", [{}, {"fmt": "%12.6f"}, {"delimiter": "\t"}])
def test_numpys_texts_are_tables_with_or_without_header(columns, options, table):
    names = [f"c{number} (deg/s)" for number in range(columns)]
    for header in ("", " ".join(names), ",".join(names), "\t".join(names)):
        content, values = saved(columns, header=header, **options)
        log = table(content)
        np.testing.assert_allclose(np.transpose(log.columns), values, atol=1e-6)
        assert log.names == (tuple(names) if header else ("",) * columns)


ROW = "0.1,1,2,3,4,5,6\n"
SPANS = "Time (s),IMU Acceleration,,,IMU Gyroscope (rad/s),,\n"


@pytest.mark.parametrize(
    ("header", "names", "preamble"),
    [
        (
            SPANS + ",X,Y,Z,X,Y,Z\n",
            "Time (s)|IMU Acceleration X|IMU Acceleration Y|IMU Acceleration Z|"
            "IMU Gyroscope X (rad/s)|IMU Gyroscope Y (rad/s)|IMU Gyroscope Z (rad/s)",
            "",
        ),
        (
            "note\nt,acc,acc,acc,gyro,gyro,gyro\n,x,y,z,x,y,z\ns,g,g,g,dps,dps,dps\n",
            "t [s]|acc x [g]|acc y [g]|acc z [g]|gyro x [dps]|gyro y [dps]|gyro z [dps]",
            "note",
        ),
        ("t,a,b,c,d,e,f\n[ms],[g],[g],[g],[dps],[dps],[dps]\n",
         "t [ms]|a [g]|b [g]|c [g]|d [dps]|e [dps]|f [dps]", ""),
        ("DeviceTag:,DOT 1,,,,,\nRate:,120,,,,,\nt,a,b,c,x,y,z\n", "t|a|b|c|x|y|z",
         "DeviceTag:,DOT 1,,,,,\nRate:,120,,,,,"),
        ("# rate 100 Hz\n# t,a[0],b,c,x,y,z\n", "t|a[0]|b|c|x|y|z", "# rate 100 Hz"),
        (",0,1,2,3,4,5\n", "|0|1|2|3|4|5", ""),
    ],
)  # fmt: skip
def test_rows_of_a_header_are_joined_and_lines_above_it_are_the_preamble(
    header, names, preamble, table
):
    log = table(header + ROW * 9)
    assert "|".join(log.names) == names
    assert log.preamble == preamble
    assert len(log.columns[0]) == 9


def test_texts_are_columns_of_texts_and_what_is_no_number_says_where(table):
    rows = [f"2024-03-01 10:00:00.{k},{'ag'[k % 2]},{k},,1.5,2" for k in range(9)]
    log = table("time,kind,n,m,x,y\n\n" + "\n".join(rows).replace("a,4", ",4"))
    assert log.columns[0][1] == "2024-03-01 10:00:00.1"
    assert log.columns[1].tolist() == ["a", "g", "a", "g", None, "g", "a", "g", "a"]
    assert np.isnan(log.columns[3]).all()
    assert log.place(5) == "row 5 (line 8)"
    with pytest.raises(InputError, match=r"numbers in 'kind', got 'a' in row 0 \(line 3\), 8 of 9"):
        log.numbers(1)


def test_thousands_separators_are_named(table):
    log = table("x,y,z\n" + '"1,234.5",2,3\n"2.5",2,3\n' * 9)
    with pytest.raises(InputError, match="without thousands separators in 'x', got '1,234.5'"):
        log.numbers(0)


def test_names_that_are_not_utf_8_come_with_the_option(table):
    text = "时间,角速度x,角速度y,角速度z\n" + "1,2,3,4\n" * 9
    assert "not UTF-8: if names look odd, give `encoding`" in table(text.encode("gbk")).listed()
    assert table(text.encode("gbk"), encoding="gbk").names[1] == "角速度x"
    assert "encoding" not in table(text).listed()
    with pytest.raises(InputError, match="as the rows, 4, got 5.*not UTF-8.*give `encoding`"):
        table(f"号,{text}".encode("gbk"))
    with pytest.raises(InputError, match="`encoding` in `reader:`.*unknown encoding: gkb"):
        table(text, encoding="gkb")


@pytest.mark.parametrize(("rows", "most"), [(100, 3), (400, 4), (1000, 10)])
def test_one_row_in_a_hundred_may_be_unreadable_but_no_more(rows, most, table):
    broken = ["x,y,z", *["1,2,3"] * (rows - most), *["1,2"] * most]
    log = table("\n".join(broken) + "\n")
    assert np.isnan(log.columns[0]).sum() == most
    with pytest.raises(InputError, match=f"got {most + 1} of {rows + 1} that are not.*row: '"):
        table("\n".join([*broken, "1,2"]) + "\n")


def test_a_finding_says_which_row_and_line_and_why(good, table):
    text = cell(9, 8, "error")(good[ANGLES])
    for content, line in ((text, 11), (text.replace("\n", "\n\n"), 21)):
        (finding,) = table(content).findings
        assert finding.detail == (
            f"1 of 60 cells of 'w_y' are no numbers and are NaN: 'error' in row 9 (line {line})"
        )


REAL = os.environ.get("GYRO_PIPELINE_REAL_DATA")


@pytest.mark.skipif(not REAL, reason="GYRO_PIPELINE_REAL_DATA names no folder of real recordings")
@pytest.mark.parametrize("unit", range(1, 6))
def test_real_dot_files_are_read_as_numpy_reads_them(unit):
    path = Path(REAL) / f"dot_x_stat_{unit}.csv"
    log = read_table(path, ReaderOptions())
    text = [re.split(",", line)[:10] for line in path.read_text().splitlines()[1:]]
    np.testing.assert_array_equal(np.transpose(log.columns[:10]), np.array(text, np.float64))
    assert not log.findings
