"""Read tables of a spreadsheet. Errors name the file, the line and the column.

Values are separated by commas, by semicolons or by tabs, as the first line is. A number may have a
decimal comma, because spreadsheets of many countries write semicolons and decimal commas.
"""

import csv
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from scene_client.schemas import MAX_LABEL
from training.datasets.files import read_lines
from training.datasets.records import MAX_LISTED, DatasetError, InvalidLinesError

MAX_LINE: Final = 4096
MAX_ROWS: Final = 100_000
_SEPARATORS: Final = (",", ";", "\t")


class Errors:
    """Errors of the rows of a table."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._listed: list[DatasetError] = []
        self._count = 0

    def add(self, error: DatasetError) -> None:
        """Count an error, and list it if it is one of the first."""
        self._count += 1
        if len(self._listed) < MAX_LISTED:
            self._listed.append(error)

    def check(self) -> None:
        """Raise the collected errors: a DatasetError for one, InvalidLinesError for several."""
        if self._count == 1:
            raise self._listed[0]
        if self._count:
            raise InvalidLinesError(self._path, self._listed, self._count)

    @contextmanager
    def collected(self) -> Iterator[None]:
        """Collect the `DatasetError` that ends the block. Other exceptions leave the block."""
        try:
            yield
        except DatasetError as error:
            self.add(error)


class Row:
    """One row of a table: the values of the columns in a line of the file."""

    def __init__(self, path: Path, line: int, values: dict[str, str]) -> None:
        self._path, self._values = path, values
        self.position = f"line {line}"

    def error(self, column: str, problem: str) -> DatasetError:
        return DatasetError(self._path, f"{self.position}, column {column}", problem)

    def __contains__(self, column: str) -> bool:
        return column in self._values

    def require_plain(self) -> None:
        """Raise DatasetError for a control character, which no name in a manifest may have."""
        for column, value in self._values.items():
            if not value.isprintable():
                raise self.error(column, "must be one line without control characters")

    def optional(self, column: str) -> str:
        """Return a text, which is empty for an empty cell and for a column that the file lacks."""
        return self._values.get(column, "")

    def text(self, column: str) -> str:
        """Return a text. Raise DatasetError if it is empty, or longer than a label."""
        if not (value := self.optional(column)):
            raise self.error(column, "is empty")
        if len(value) > MAX_LABEL:
            raise self.error(column, f"has more than {MAX_LABEL} characters")
        return value

    def one_of(self, column: str, choices: Sequence[str]) -> str:
        """Return one of the choices. Raise DatasetError for another value."""
        if (value := self.optional(column)) not in choices:
            named = ", ".join(choice or "empty" for choice in choices)
            raise self.error(column, f"must be one of {named}, not {value!r}")
        return value

    def number(self, column: str, most: float = math.inf) -> float:
        """Return a number above 0 and up to ``most``. Raise DatasetError for another value."""
        shown = self.optional(column)
        try:
            value = float(shown.replace(",", "."))
        except ValueError:
            value = math.nan
        if not 0 < value <= most or math.isinf(value):
            limit = "" if math.isinf(most) else f" and at most {most:g}"
            raise self.error(column, f"must be a number above 0{limit}, not {shown!r}")
        return value


def read_table(
    path: Path, columns: Sequence[str], errors: Errors, optional: Sequence[str] = ()
) -> Iterator[Row]:
    """Yield the rows of a UTF-8 table that has the `columns`, and may have the `optional` ones."""
    line = 1
    try:
        lines = _decoded(path)
        head = next(lines, "")
        separator = max(_SEPARATORS, key=head.count)
        names = [name.strip() for name in next(csv.reader([head], delimiter=separator), [])]
        _check_names(path, names, columns, optional)
        reader = csv.reader(lines, delimiter=separator, strict=True)
        for values in reader:
            line = 1 + reader.line_num
            if line > MAX_ROWS:
                raise DatasetError(path, "", f"has more than {MAX_ROWS} lines")
            if not any(map(str.strip, values)):
                continue
            if len(values) != len(names):
                problem = f"the row has {len(values)} values, not {len(names)}"
                errors.add(DatasetError(path, f"line {line}", problem))
                continue
            row = Row(path, line, dict(zip(names, map(str.strip, values), strict=True)))
            with errors.collected():
                row.require_plain()
                yield row
    except csv.Error as error:
        errors.add(DatasetError(path, f"line {line + 1}", f"is no row: {error}"))
    except DatasetError as error:
        errors.add(error)


def _decoded(path: Path) -> Iterator[str]:
    """Yield the lines of a UTF-8 file. Raise DatasetError with the number of an invalid line."""
    for number, line in enumerate(read_lines(path, MAX_LINE), 1):
        try:
            yield line.decode("utf-8-sig")
        except UnicodeDecodeError as error:
            problem = f"is not UTF-8: {error}; save the table as CSV UTF-8"
            raise DatasetError(path, f"line {number}", problem) from error


def _check_names(
    path: Path, names: Sequence[str], columns: Sequence[str], optional: Sequence[str]
) -> None:
    """Raise DatasetError if a column is missing, named twice or unknown."""
    if missing := [name for name in columns if name not in names]:
        raise DatasetError(path, "line 1", f"must name the columns {', '.join(missing)}")
    named = [name for name in names if name]  # a spreadsheet may write empty columns
    if twice := sorted({name for name in named if named.count(name) > 1}):
        raise DatasetError(path, "line 1", f"names the column {twice[0]} twice")
    if unknown := [name for name in named if name not in (*columns, *optional)]:
        names = ", ".join((*columns, *optional))
        raise DatasetError(path, "line 1", f"has the unknown column {unknown[0]!r}; known: {names}")
