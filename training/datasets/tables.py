"""Read tables of comma-separated values. Errors name the file, the line and the column."""

import csv
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from training.datasets.files import read_lines
from training.datasets.records import DatasetError

MAX_LINE: Final = 4096
MAX_ROWS: Final = 1_000_000


class Row:
    """One row of a table.

    Args:
        path: path of the file.
        line: number of the line, from 1.
        values: value of each column.
    """

    def __init__(self, path: Path, line: int, values: dict[str, str]) -> None:
        self._path, self._line, self._values = path, line, values

    def error(self, column: str, problem: str) -> DatasetError:
        """Return an error about a value of the row."""
        return DatasetError(self._path, f"line {self._line}, column {column}", problem)

    def optional(self, column: str) -> str:
        """Return a text, which may be empty."""
        return self._values[column]

    def text(self, column: str) -> str:
        """Return a text. Raise DatasetError if it is empty."""
        if not (value := self._values[column]):
            raise self.error(column, "is empty")
        return value

    def one_of(self, column: str, choices: Sequence[str]) -> str:
        """Return one of the choices. Raise DatasetError for another value."""
        if (value := self._values[column]) not in choices:
            raise self.error(column, f"must be one of {', '.join(choices)}, not {value!r}")
        return value

    def number(self, column: str, most: float = math.inf) -> float:
        """Return a number above 0 and up to ``most``. Raise DatasetError for another value."""
        try:
            value = float(self._values[column])
        except ValueError:
            value = math.nan
        if not 0 < value <= most or math.isinf(value):
            limit = "" if math.isinf(most) else f" and at most {most:g}"
            shown = self._values[column]
            raise self.error(column, f"must be a number above 0{limit}, not {shown!r}")
        return value


def read_table(path: Path, columns: Sequence[str]) -> Iterator[Row]:
    """Yield the rows of a table in UTF-8, whose first line names the columns.

    Spaces around values are removed. Blank lines are skipped.

    Raises:
        DatasetError: the file cannot be read, lacks a column, or has a row of another length.
    """
    lines = read_lines(path, MAX_LINE)
    reader = csv.reader((line.decode("utf-8-sig") for line in lines), strict=True)
    try:
        names = [name.strip() for name in next(reader, [])]
        if missing := [name for name in columns if name not in names]:
            raise DatasetError(path, "line 1", f"must name the columns {', '.join(missing)}")
        for values in reader:
            if reader.line_num > MAX_ROWS:
                raise DatasetError(path, "", f"has more than {MAX_ROWS} lines")
            if len(values) not in (0, len(names)):
                problem = f"the row has {len(values)} values, not {len(names)}"
                raise DatasetError(path, f"line {reader.line_num}", problem)
            if any(values):
                row = dict(zip(names, map(str.strip, values), strict=True))
                yield Row(path, reader.line_num, row)
    except UnicodeDecodeError as error:
        raise DatasetError(path, f"line {reader.line_num + 1}", f"is not UTF-8: {error}") from error
    except csv.Error as error:
        raise DatasetError(path, f"line {reader.line_num}", f"is no row: {error}") from error
