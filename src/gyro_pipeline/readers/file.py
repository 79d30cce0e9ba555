"""A table with its headers, its format and the options, which determine how it is read."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from gyro_pipeline.conventions import IN_READER, InputError
from gyro_pipeline.logs import KEPT, Finding
from gyro_pipeline.parameters import Column, ReaderOptions
from gyro_pipeline.readers.formats import Format, format_of
from gyro_pipeline.readers.names import Header, read_headers
from gyro_pipeline.readers.table import Table


@dataclass
class File:
    """A table and how to read it; collects contradictions and findings."""

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
        """Add a finding."""
        self.findings.append(Finding(check, outcome, text))

    def add_contradiction(self, text: str) -> None:
        """Add a contradiction, which is refused unless the options are trusted."""
        self.contradictions.append(text)

    def refusal(self, text: str) -> InputError:
        """An error that names the file, and the place of the options to change."""
        return InputError(f"{self.table.where}: {text} {IN_READER}")

    def settle(self) -> None:
        """Refuse contradictions, or turn them into findings if the options are trusted.

        Raises:
            InputError: A contradiction exists, and the options are not trusted.
        """
        if self.contradictions and self.options.trust is None:
            text = "; and ".join(self.contradictions)
            raise self.refusal(f"{text}; or, if the options are right, trust: options")
        for text in self.contradictions:
            self.note("trust: options", f"overruled: {text}")

    def find(self, column: Column) -> int:
        """Find a column by its name, with or without its unit, or by its number from 0.

        Raises:
            InputError: No column or several columns match.
        """
        names = self.table.names
        matches = [number for number, name in enumerate(names) if column in (number, name)]
        matches = matches or [n for n, header in enumerate(self.headers) if header.name == column]
        if len(matches) == 1:
            return matches[0]
        raise self.refusal(
            f"expected one column {column!r}, got {len(matches)}, numbers {matches} (from 0), in "
            f"{len(names)} columns, {self.table.listed()}; correct it, or, if a file has two "
            "sensors, give numbers instead of names"
        )
