"""Lines that are no table: the refusal shows an expression, and pasted, it reads them."""

import re

import numpy as np
import pytest
import yaml

from gyro_pipeline.conventions import InputError

VALUES = np.random.default_rng(3).normal(0, 20, (40, 3)).round(3)
LINES = {  # how a line is written, and the groups that the expression has
    "VectorNav": ("$VNYMR,{t},{x:+08.3f},{y:+08.3f},{z:+08.3f}*{k:02X}", "v1 v2 v3 v4"),
    "labels without blanks": ("gx:{x},gy:{y},gz:{z}", "gx gy gz"),
    "an unlucky quote": ("it's ({x} | {y} | {z}) deg/s", "v1 v2 v3"),
    "labels that are there again": ("t: {t} t: {t} t: {t} | {x} {y} {z}", "t t_ t__ v4 v5 v6"),
}
BOOT = ["ets Jun  8 2016 00:22:57", "rst:0x1 (POWERON_RESET)", "", "I2C ok"]


def written(form):
    rows = [
        form.format(k=k, t=k / 100, x=x, y=y, z=z) for k, (x, y, z) in enumerate(VALUES.tolist())
    ]
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
