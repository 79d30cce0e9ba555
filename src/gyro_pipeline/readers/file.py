"""A table, what its names say, the options and the format: all that decides how it is read."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from gyro_pipeline.conventions import InputError
from gyro_pipeline.logs import KEPT, Finding
from gyro_pipeline.parameters import Column, ReaderOptions
from gyro_pipeline.readers.formats import Format, format_of
from gyro_pipeline.readers.names import Header, read_headers
from gyro_pipeline.readers.table import IN_READER, Table


@dataclass
class File:
    """Decides by name, and collects what contradicts each other and what is worth a word."""

    table: Table
    options: ReaderOptions
    contradictions: list[str] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.headers: tuple[Header, ...] = read_headers(self.table.names)
        self.form: Format | None = format_of(self.table, self.options.format)

    def listed(self, numbers: Sequence[int]) -> str:
        """Names of columns, for a message."""
        return ", ".join(repr(self.table.names[n] or f"column {n}") for n in numbers)

    def note(self, check: str, text: str, outcome: str = KEPT) -> None:
        """Something to say, whatever comes of it."""
        self.findings.append(Finding(check, outcome, text))

    def contradict(self, text: str) -> None:
        """Something that can be read in two ways, of which only the options can say the right."""
        self.contradictions.append(text)

    def refusal(self, text: str) -> InputError:
        """An error that says where, and in which file to type what it asks for."""
        return InputError(f"{self.table.where}: {text} {IN_READER}")

    def settle(self) -> None:
        """Refuse what can be read in two ways, unless the options are trusted, which is then said.

        Raises:
            InputError: Something contradicts, and the options are not trusted.
        """
        if self.contradictions and self.options.trust is None:
            others = len(self.contradictions) - 1
            more = f" (and {others} more)" if others else ""
            text = f"{self.contradictions[0]}{more}; or, if the options are right, trust: options"
            raise self.refusal(text)
        for text in self.contradictions:
            self.note("trust: options", f"overruled: {text}")

    def find(self, column: Column) -> int:
        """Look up a column by its name, with or without its unit, or by its number from 0.

        Raises:
            InputError: There is no such column, or more than one.
        """
        names = self.table.names
        alike = [number for number, name in enumerate(names) if column in (number, name)]
        alike = alike or [n for n, header in enumerate(self.headers) if header.name == column]
        if len(alike) == 1:
            return alike[0]
        raise self.refusal(
            f"expected one column {column!r}, got {len(alike)}, numbers {alike} (from 0), in "
            f"{len(names)} columns, {self.table.listed()}; correct it, or, of two sensors in one "
            "file, give numbers in place of names"
        )
