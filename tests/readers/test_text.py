"""Delimited texts, odd and damaged ones: each is the table that it should be, or a message.

That of lines that are no table shows an expression, and pasted, it reads them.
"""

import re

import numpy as np
import pytest
import yaml

from gyro_pipeline.conventions import InputError


def lines(change):
    """A change of the list of lines, the header first."""
    return lambda text: "\n".join(change(text.splitlines())) + "\n"


def cell(row, column, text):
    """Another text in one cell of a row of the logger of angles."""

    def change(rows):
        fields = rows[row + 1].split(",")
        fields[column] = text
        return [*rows[: row + 1], ",".join(fields), *rows[row + 2 :]]

    return lines(change)


def replaced(old, new):
    return lambda text: text.replace(old, new)


def inserted(at, *new):
    return lines(lambda rows: [*rows[:at], *new, *rows[at:]])


def in_quotes(text):
    return '"' + text.strip().replace(";", '";"').replace("\n", '"\n"') + '"\n'


WHOLE = {  # all rows come back and nothing is said
    "lines above the header": ("dot", str),
    "byte order mark": ("angles", lambda t: t.encode("utf-8-sig")),
    "UTF-16": ("general", lambda t: t.encode("utf-16")),
    "a degree sign in another encoding": ("general", lambda t: t.encode("cp1252")),
    "CR only": ("angles", replaced("\n", "\r")),
    "quoted fields": ("general", in_quotes),
    "tabs": ("general", replaced(";", "\t")),
    "decimal commas": ("general", replaced(".", ",")),
    "commas in texts": ("general", replaced("\n", ";Sun, 31\n")),
    "lines between header and rows": ("general", inserted(1, "", "started; at noon", "# 1")),
    "zeros of a card at the end": ("angles", lambda t: t.encode() + bytes(4096)),
}  # fmt: skip
SAID = "unreadable rows"
DAMAGED = {  # rows that are NaN, and what is said
    "NaN": (cell(9, 7, " NaN"), [9], ""),
    "the first rates empty": (replaced("2.95188,-0.97946,0.38510", ",,"), [0], ""),
    "text in a number column": (cell(9, 8, "error"), [9], SAID),
    "bytes that are no text": (
        lambda t: cell(9, 8, "@@")(t).encode().replace(b"@@", b"\xff\xfe"), [9], SAID),
    "the last line cut": (lambda t: t[:-20], [59], SAID),
    "a field too many in the first row": (cell(0, 2, "1,2"), [0], SAID),
    "a message between rows": (inserted(31, "SD card slow"), [30], SAID),
}  # fmt: skip


def samples(log):
    return np.stack([log.numbers(log.names.index(name)) for name in "xyz"], axis=1)


@pytest.mark.parametrize("case", WHOLE)
def test_an_odd_text_is_read_whole(case, good, rates, table):
    logger, change = WHOLE[case]
    log = table(change(good[logger]))
    np.testing.assert_array_equal(samples(log), rates)
    assert not log.findings


@pytest.mark.parametrize("case", DAMAGED)
def test_damage_of_a_few_rows_is_nan_and_said(case, good, rates, table):
    change, nan, finding = DAMAGED[case]
    log = table(change(good["angles"]))
    values = samples(log)
    whole = np.isfinite(values).all(axis=1)
    assert np.flatnonzero(~whole).tolist() == nan
    left = np.delete(rates, nan, axis=0) if len(values) == len(rates) else rates
    np.testing.assert_array_equal(values[whole], left)
    assert [f.check for f in log.findings] == ([finding] if finding else [])


REFUSED = {
    "empty": ("angles", lambda t: "", "got an empty file"),
    "one row": ("angles", lines(lambda t: t[:2]), "none in the first 2 lines; line 1 begins 'Time"),
    "UTF-16 without mark": ("angles", lambda t: t.encode("utf-16-le"), "`encoding: utf-16-le`"),
    "another delimiter": ("angles", lambda t: re.sub(", ?", "|", t), "or '.t' or ' ', got none"),
    "fewer columns from a row on": (
        "angles", lines(lambda t: t[:31] + [line.rsplit(",", 3)[0] for line in t[31:]]),
        "got 30 of 60 that are not: row 30 .line 32."),
    "a comma too many in a header without the last": (
        "angles", lambda t: t.replace("psi,", "psi,,").replace("z,\n", "z\n"), "rows, 10, got 11"),
    "two recordings": ("angles", lambda t: t + t, "a second header in row 60 .line 62."),
    "a column of thousands": (
        "general", replaced(";0.", ";1,000."), "numbers in 'z', without thousands"),
    "what may be thousands": (
        "general", lambda t: "x;y;z\n" + "1,024;2,048;-3,072\n" * 9, "a comma before three digits"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_read_safely_is_refused(case, good, table):
    logger, change, message = REFUSED[case]
    with pytest.raises(InputError, match=f"log.csv.*{message}"):
        samples(table(change(good[logger])))


@pytest.mark.parametrize(
    ("header", "names", "preamble"),
    [
        ("note\nt,acc,acc,acc,gyro (dps),,\n,x,y,z,x,y,z\n",
         "t|acc x|acc y|acc z|gyro x (dps)|gyro y (dps)|gyro z (dps)", "note"),
        ("t,acc,acc,acc,gyro,gyro,gyro\n,x,y,z,x,y,z\ns,g,g,g,dps,dps,dps\n",
         "t [s]|acc x [g]|acc y [g]|acc z [g]|gyro x [dps]|gyro y [dps]|gyro z [dps]", ""),
        ("t,a,b,c,d,e,f\n[ms],[g],[g],[g],[dps],[dps],[dps]\n",
         "t [ms]|a [g]|b [g]|c [g]|d [dps]|e [dps]|f [dps]", ""),
        ("DeviceTag:,DOT 1,,,,,\nRate:,120,,,,,\nt,a,b,c,x,y,z\n", "t|a|b|c|x|y|z",
         "DeviceTag:,DOT 1,,,,,\nRate:,120,,,,,"),
        ("# rate 100 Hz\n# t,a[0],b,c,x,y,z\n", "t|a[0]|b|c|x|y|z", "# rate 100 Hz"),
        (",0,1,2,3,4,5\n", "|0|1|2|3|4|5", ""),
    ],
)  # fmt: skip
def test_rows_of_a_header_are_joined_and_lines_above_are_a_preamble(header, names, preamble, table):
    log = table(header + "0.1,1,2,3,4,5,6\n" * 9)
    assert ("|".join(log.names), log.preamble) == (names, preamble)
    assert len(log.columns[0]) == 9


def test_texts_are_columns_and_what_is_no_number_says_where(table):
    rows = [f"2024-03-01 10:00:00.{k},{'ag'[k % 2]},{k},,1.5,2" for k in range(9)]
    log = table("time,kind,n,m,x,y\n\n" + "\n".join(rows).replace("a,4", ",4"))
    assert log.columns[0][1] == "2024-03-01 10:00:00.1"
    assert log.columns[1].tolist() == ["a", "g", "a", "g", None, "g", "a", "g", "a"]
    assert np.isnan(log.columns[3]).all()
    with pytest.raises(InputError, match=r"in 'kind'.*got 'a' in row 0 \(line 3\), 8 of 9 rows"):
        log.numbers(1)


def test_options_say_how_a_text_is_coded_and_split(table):
    text = "时间,角速度x,角速度y,角速度z\n" + "1,2,3,4\n" * 9
    assert "not UTF-8: if names look odd, give `encoding`" in table(text.encode("gbk")).where
    assert table(text.encode("utf-16-le"), encoding="utf-16-le").names[1] == "角速度x"
    assert "encoding" not in table(text).where
    with pytest.raises(InputError, match="`encoding` in `reader:`.*unknown encoding: gkb"):
        table(text, encoding="gkb")
    assert table("a|b|c\n" + "1|2|3\n" * 9, delimiter="|").names == ("a", "b", "c")


def test_one_row_in_a_hundred_may_be_unreadable_but_no_more_and_takes_no_other_with_it(table):
    broken = ["x,y,z", *["1,2,3"] * 990, *["1,2"] * 10]
    assert np.isnan(table("\n".join(broken)).columns[0]).sum() == 10
    with pytest.raises(InputError, match="got 11 of 1001 that are not.*row: '"):
        table("\n".join([*broken, "1,2"]))
    for stray in ('"9","1.5","', '"9,"1.5","3"'):
        rows = ['"1","2","3"'] * 9
        log = table("\n".join(['"x","y","z"', *rows, stray, *rows, stray, *rows]))
        assert np.flatnonzero(np.isnan(log.columns[0])).tolist() == [9, 19]
        assert "row 19 (line 21)" in log.findings[0].detail
        assert len(log.columns[0]) == 29


VALUES = np.random.default_rng(3).normal(0, 20, (40, 3)).round(3)
LINES = {  # how a line is written, and the groups that the expression has
    "VectorNav": ("$VNYMR,{t},{x:+08.3f},{y:+08.3f},{z:+08.3f}*{k:02X}", "v1 v2 v3 v4"),
    "labels without blanks": ("gx:{x},gy:{y},gz:{z}", "gx gy gz"),
    "an unlucky quote": ("it's ({x} | {y} | {z}) deg/s", "v1 v2 v3"),
    "labels that are there again": ("t: {t} t: {t} t: {t} | {x} {y} {z}", "t t_ t__ v4 v5 v6"),
}
BOOT = ["ets Jun  8 2016 00:22:57", "rst:0x1 (POWERON_RESET)", "", "I2C ok"]


def written(form):
    values = enumerate(VALUES.tolist())
    rows = [form.format(k=k, t=k / 100, x=x, y=y, z=z) for k, (x, y, z) in values]
    return "\n".join([*BOOT, *rows[:20], "brown-out, 3 times", *rows[20:]]) + "\n"


@pytest.mark.parametrize("name", LINES)
def test_the_expression_of_a_refusal_reads_the_lines_when_pasted(name, table):
    form, groups = LINES[name]
    with pytest.raises(InputError) as refusal:
        table(written(form))
    pasted = re.search(r"in catalog.yml: (row: '.*') –", str(refusal.value))
    log = table(written(form), **yaml.safe_load(pasted[1]))
    assert log.names == tuple(groups.split())
    read = np.stack([log.numbers(n) for n in range(len(log.names) - 3, len(log.names))], axis=1)
    np.testing.assert_array_equal(read, VALUES)
    (skipped,) = log.findings
    assert skipped.detail.startswith("4 of 44 lines do not match `row` and were skipped, the first")
    assert log.position(20) == "row 20 (line 26)"
    assert log.preamble == "\n".join(BOOT)


def test_an_expression_that_reads_nothing_is_refused_with_one_that_does(table):
    for row, message in (
        ("(", "`row:` in `reader:` .* is not a regular expression"),
        (r"(\d), (\d)", "expected named groups.*got 0 groups.*row: '.gyro="),
        (r"acc=(?P<x>\d)", "got 1 groups and 0 of 9 lines.*row: '.gyro="),
    ):
        with pytest.raises(InputError, match=message):
            table("gyro=(1, 2, 3)\n" * 9, row=row)
