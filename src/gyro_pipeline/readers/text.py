"""Rows of delimited text, read by Arrow as fast as it parses.

A file that Arrow cannot read as numbers is read once more as text, and looked at row by row.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
from numpy.typing import NDArray

from gyro_pipeline.conventions import InputError
from gyro_pipeline.logs import KEPT, REPAIRED, Finding
from gyro_pipeline.readers.fields import DELIMITERS, is_header, split

_BAD_SHARE, _BAD_ROWS = 0.01, 3
"""Rows that cannot be read become NaN up to this share of them, and always up to this number."""

_NUMBER = r"^[+-]?((\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|(?i:inf|infinity|nan))$"
_THOUSANDS = re.compile(r"[+-]?\d{1,3}([,' .]\d{3})+([.,]\d+)?")
_COMMENTS = re.compile(rb"(?:\A|(?<=[\r\n]))[ \t]*(?:#|%|//)[^\r\n]*")
_NULLS = ["", "NaN", "nan", "NAN", "-nan", "NA", "N/A", "null", "NULL", "None"]

Values = tuple[list[NDArray[np.float64]], tuple[Finding, ...]]
Odd = dict[int, str]
"""What is wrong, by row."""


@dataclass(frozen=True)
class TextTable:
    """Rows of numbers in a text, whose header is known (see ``readers.tables.Table``).

    Attributes:
        path: Of the file.
        names: The header, without quotes; all empty where there is none.
        preamble: Lines before it.
        data: Bytes of the file, in ASCII or a superset of it.
        start: Where its rows begin in them.
        header_lines: Lines before the rows.
        delimiter: Between fields.
        quoted: Whether fields are in quotes; if not, a stray quote is one more damaged field.
        decimal_point: A point or a comma.
        times: Arrow's type of the columns of times of day and of dates with times.
    """

    path: Path
    names: tuple[str, ...]
    preamble: str
    data: bytes
    start: int
    header_lines: int
    delimiter: str
    quoted: bool
    decimal_point: str
    times: Mapping[int, Any]

    @property
    def in_seconds(self) -> frozenset[int]:
        """Columns that are read as seconds, whatever the header says."""
        return frozenset(self.times)

    def read(self, columns: Sequence[int], lenient: int | None = None) -> Values:
        """Read columns (see ``readers.tables.Table``)."""
        end, findings = self._end(columns)
        body = memoryview(self.data)[self.start : end]  # not a copy
        if not self.data.isascii():  # Arrow would drop odd rows that are not UTF-8 without a word
            body = memoryview(bytes(body).decode("utf-8", "replace").encode())
        try:
            table, odd = self._parse(body, {n: self.times.get(n, pa.float64()) for n in columns})
            values, unreadable = [_numbers(table[str(n)]) for n in columns], {}
        except pa.ArrowInvalid:
            table, odd = self._parse(body, dict.fromkeys(columns, pa.string()))
            values, unreadable = self._converted(table, columns, lenient)
            kept = np.setdiff1d(np.arange(table.num_rows + len(odd)), list(odd))
            unreadable = {int(kept[row]): what for row, what in unreadable.items()}
        if any(_is_comment(self._lines[row][1]) for row in (*odd, *unreadable)):
            rows_only = _COMMENTS.sub(b"", self.data[self.start :])  # blank lines are no rows
            if len(rows_only) < len(self.data) - self.start:
                whole = replace(self, data=self.data[: self.start] + rows_only)
                values, more = whole.read(columns, lenient)
                text = "lines of comment among the rows were left out"
                return values, (*more, Finding("comments", KEPT, text))
        rows = table.num_rows + len(odd)
        self._check(odd | unreadable, rows)
        if odd or unreadable:
            at = np.array(sorted(odd), int) - np.arange(len(odd))  # as np.insert counts
            values = [np.insert(column, at, np.nan) for column in values]
            findings += (self._finding(odd | unreadable, rows),)
        return values, findings

    def _end(self, columns: Sequence[int]) -> tuple[int, tuple[Finding, ...]]:
        """Where the rows end but for what an interrupted recording leaves behind them."""
        findings: tuple[Finding, ...] = ()
        end = len(self.data.rstrip(b"\0"))
        if zeros := len(self.data) - end:
            text = f"{zeros} zero bytes at the end of the file were left out"
            findings += (Finding("end of file", REPAIRED, text),)
        line = 1 + max(self.data.rfind(one, self.start, end) for one in (b"\n", b"\r"))
        line = max(line, self.start)
        last = split(self.data[line:end].decode("utf-8", "replace"), self.delimiter)
        if last and (len(last) != len(self.names) or len(last) - 1 in columns):
            text = f"the last line, of {end - line} bytes, has no line end and may be cut; it was "
            findings += (Finding("end of file", REPAIRED, f"{text}left out"),)
            end = line
        if end <= self.start:
            raise InputError(f"{self.path}: expected rows of numbers, got none but a cut one")
        return end, findings

    def _parse(self, body: memoryview, kinds: dict[int, Any]) -> tuple[Any, Odd]:
        """Let Arrow parse; rows of another number of fields are left out of the table."""
        odd: Odd = {}

        def skip(row: Any) -> str:
            text = f"expected {row.expected_columns} fields, got {row.actual_columns}"
            odd[row.number - 1] = text
            return "skip"

        table = pyarrow.csv.read_csv(
            pa.BufferReader(pa.py_buffer(body)),
            pyarrow.csv.ReadOptions(
                use_threads=False,
                block_size=min(len(body) + 1, 2**31 - 1),  # so that no line is too long
                column_names=[str(number) for number in range(len(self.names))],
            ),
            pyarrow.csv.ParseOptions(
                delimiter=self.delimiter,
                quote_char='"' if self.quoted else False,
                invalid_row_handler=skip,
            ),
            self._conversion(kinds),
        )
        if self.quoted:
            self._refuse_rows_over_lines(table.num_rows + len(odd), body)
        return table, odd

    def _conversion(self, kinds: dict[int, Any]) -> Any:
        return pyarrow.csv.ConvertOptions(
            include_columns=[str(number) for number in kinds],
            column_types={str(number): kind for number, kind in kinds.items()},
            null_values=_NULLS,
            strings_can_be_null=True,
            decimal_point=self.decimal_point,
        )

    def _converted(self, table: Any, columns: Sequence[int], lenient: int | None) -> Any:
        """Turn text into numbers where it is one; say in which rows it is not."""
        values: list[NDArray[np.float64]] = []
        unreadable: Odd = {}
        for number in columns:
            texts = pc.utf8_trim_whitespace(table[str(number)])
            column = self._seconds(texts, number) if number in self.times else self._number(texts)
            values.append(column)
            rows = np.flatnonzero(np.isnan(column) & ~texts.is_null().to_numpy())
            found = zip(rows.tolist(), texts.take(pa.array(rows)).to_pylist(), strict=True)
            wrong = {row: text for row, text in found if text.lower().lstrip("+-") != "nan"}
            what = self.names[number] or f"column {number}"
            self._refuse_thousands(wrong.values(), what)
            if number != lenient:
                unreadable |= {
                    row: f"{what}: expected a number, got {text[:40]!r}"
                    for row, text in wrong.items()
                }
        return values, unreadable

    def _number(self, texts: Any) -> NDArray[np.float64]:
        """Numbers; NaN where there is none. Where commas are decimal, a point is no part of one."""
        points = pc.replace_substring(texts, self.decimal_point, ".")
        good = pc.match_substring_regex(points, _NUMBER)
        if self.decimal_point != ".":
            good = pc.and_(good, pc.invert(pc.match_substring(texts, ".")))
        return _numbers(pc.if_else(good, points, None).cast(pa.float64()))

    def _seconds(self, texts: Any, number: int) -> NDArray[np.float64]:
        """Seconds since midnight, or since the first date; NaN where there is neither."""
        series = pd.Series(texts.to_pylist(), dtype="object")
        if pa.types.is_time(self.times[number]):
            since = pd.to_timedelta(series, errors="coerce")
        else:
            times = pd.to_datetime(series, errors="coerce", format="ISO8601", utc=True)
            since = times - times.min()
        return np.asarray(since.dt.total_seconds(), np.float64)

    def _refuse_rows_over_lines(self, rows: int, body: memoryview) -> None:
        lines = sum(map(bool, bytes(body).splitlines()))
        if rows != lines:
            raise InputError(
                f"{self.path}: expected a row on each line, got {rows} rows on {lines} lines: a "
                "quoted field does not end on its line; correct it"
            )

    def _refuse_thousands(self, texts: Iterable[str], what: str) -> None:
        for text in texts:
            if _THOUSANDS.fullmatch(text):
                raise InputError(
                    f"{self.path}: {what}: expected numbers without thousands separators, got "
                    f"{text!r}; export them without"
                )

    @cached_property
    def _lines(self) -> list[tuple[int, str]]:
        """Number in the file, from 1, and text of each line that Arrow sees as a row."""
        lines = self.data[self.start :].rstrip(b"\0").splitlines()
        return [
            (self.header_lines + 1 + number, line.decode("utf-8", "replace"))
            for number, line in enumerate(lines)
            if line
        ]

    def _check(self, bad: Odd, rows: int) -> None:
        """Refuse a file of which too much cannot be read, or with a second header."""
        for row in sorted(bad)[:100]:
            line, text = self._lines[row]
            if is_header(split(text, self.delimiter)):
                raise InputError(
                    f"{self.path} line {line} (row {row}): expected numbers, got a second header, "
                    f"{text[:80]!r}: two recordings in one file? Split it"
                )
        if rows - len(bad) < 2 and not bad:  # noqa: PLR2004
            raise InputError(f"{self.path}: expected rows of numbers, got one only")
        if rows - len(bad) < 2 or len(bad) > max(_BAD_ROWS, _BAD_SHARE * rows):  # noqa: PLR2004
            raise InputError(
                f"{self.path}: expected rows of {len(self.names)} columns of numbers, "
                f"{DELIMITERS[self.delimiter]}-separated, got {len(bad)} of {rows} that are not: "
                f"{self._shown(bad)}; correct or export the file anew"
            )

    def _finding(self, bad: Odd, rows: int) -> Finding:
        text = f"{len(bad)} of {rows} rows cannot be read and are NaN: {self._shown(bad)}"
        return Finding("unreadable rows", REPAIRED, text)

    def _shown(self, bad: Odd) -> str:
        first = sorted(bad)[:3]
        texts = [f"row {row} (line {self._lines[row][0]}): {bad[row]}" for row in first]
        return "; ".join(texts) + ("; …" if len(bad) > len(first) else "")


def _is_comment(line: str) -> bool:
    return _COMMENTS.match(line.encode()) is not None


def _numbers(column: Any) -> NDArray[np.float64]:
    """Values of a column of numbers or times, the latter in seconds; null is NaN."""
    if pa.types.is_floating(column.type):
        return np.array(column.to_numpy())
    return column.cast(pa.int64()).to_numpy() * 1e-6
