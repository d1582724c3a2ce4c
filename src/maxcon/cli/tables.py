"""Tables of numbers from CSV and NPY files, and the problems that their columns pose."""

from __future__ import annotations

import csv
import io
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray

from maxcon.cli.errors import Failure
from maxcon.datasets.classic import TABLES
from maxcon.problem import LinearProblem, hyperplane, line, plane

#: Candidates for what separates the cells of a line; " " stands for any run of blanks.
DELIMITERS = (";", "\t", ",", " ")

#: How many lines are looked at to find the delimiter.
SNIFFED_LINES = 50

#: How many columns each model takes; None: two or more.
N_COLUMNS: dict[str, int | None] = {"line": 2, "plane": 3, "hyperplane": None}


@dataclass(frozen=True, eq=False)
class DataTable:
    """A table whose cells have not been looked at yet: only columns that are used need hold numbers.

    Attributes
    ----------
    source
        The name of the file, for messages.
    names
        One name a column: from the header, or "column 1" and so on.
    cells
        Shape (N, columns): text from a CSV file, numbers from an NPY file.
    places
        Where each row stands in the file, for messages: "line 7" or "row 7".
    guessed
        Whether nobody has said that the first row is data: it is a line of text that may be a header.
    """

    source: str
    names: tuple[str, ...]
    cells: list[list[str]] | NDArray[np.float64]
    places: Sequence[str]
    guessed: bool = False

    def numbers(self, columns: Sequence[int]) -> NDArray[np.float64]:
        """Return the chosen columns, shape (N, len(columns)); Failure names the first cell that is no finite number.

        Where the first row may be a header after all, a note on stderr says that it is taken for data.
        """
        values = np.empty((len(self.cells), len(columns)))
        for row, cells in enumerate(self.cells):
            for slot, column in enumerate(columns):
                value = _number(cells[column])
                if value is None or not math.isfinite(value):
                    hint = "; --header takes this line for names" if self.guessed and row == 0 else ""
                    fault = _fault(cells[column]) + hint
                    raise Failure(f"{self.source}, {self.places[row]}, {self._label(column)}: {fault}")
                values[row, slot] = value
        if self.guessed and _looks_like_names([[str(row[column]) for column in columns] for row in self.cells]):
            first = _listed([str(self.cells[0][column]) for column in columns])
            click.echo(
                f"note: {self.places[0]} of {self.source} ({first}) is taken for data; --header takes it for names, "
                "--no-header silences this note",
                err=True,
            )
        return values

    def _label(self, column: int) -> str:
        given = f"column {column + 1}"
        return given if self.names[column] == given else f"{given} ({self.names[column]})"


def read_table(file: str, header: bool | None = None) -> DataTable:
    """Read a CSV or NPY file, told apart by their first bytes; "-" is standard input.

    Whether the first line of CSV text is a header may be told; None: it is one if it has no number.

    Where there is no such file, the name may be that of a table in the package (`maxcon.datasets.classic`).

    Raises
    ------
    Failure
        If the file cannot be read, holds no data, or is neither, or an NPY file is told to have a header.
    """
    source = "standard input" if file == "-" else file
    try:
        content = sys.stdin.buffer.read() if file == "-" else Path(file).read_bytes()
    except FileNotFoundError:
        if file not in TABLES:
            raise Failure(f"there is no file {file!r}, and no table of that name: {', '.join(TABLES)}") from None
        content = (files("maxcon.datasets") / "tables" / f"{file}.csv").read_bytes()
    except IsADirectoryError:
        raise Failure(f"{file!r} is a folder, not a file") from None
    except OSError as error:
        raise Failure(f"cannot read {file!r}: {error.strerror}") from None
    if content.startswith(b"\x93NUMPY"):
        if header:
            raise Failure(f"{source} is an NPY file, which has no header line")
        return _parse_npy(content, source)
    if content.startswith(b"PK"):
        raise Failure(f"{source} is a zip archive (NPZ, XLSX?): only CSV text and NPY arrays can be read")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise Failure(f"{source} is neither an NPY file nor UTF-8 text (byte {error.start + 1})") from None
    return _parse_csv(text, source, header)


def choose_columns(table: DataTable, wanted: str | None, model: str) -> list[int]:
    """Return the columns to fit, the dependent one last.

    Parameters
    ----------
    table
        The table.
    wanted
        Names or 1-based numbers, separated by commas; None for all columns.
    model
        A key of `N_COLUMNS`.

    Raises
    ------
    Failure
        If there is no such column, one is named twice, or the model takes another number of columns.
    """
    if wanted is None:
        columns = list(range(len(table.names)))
    else:
        columns = [_find_column(table, each.strip()) for each in wanted.split(",")]
    for position, column in enumerate(columns):
        if column in columns[:position]:
            raise Failure(f"--columns names column {column + 1} ({table.names[column]}) twice")
    needed = N_COLUMNS[model]
    if (needed is None and len(columns) < 2) or (needed is not None and len(columns) != needed):
        takes = f"a {model} takes {'at least 2' if needed is None else needed} columns, the dependent one last"
        if wanted is None:
            has = "1 column" if len(columns) == 1 else f"{len(columns)} columns"
            hint = "; choose with --columns" if needed is not None and len(columns) > needed else ""
            raise Failure(f"{takes}, but {table.source} has {has} ({_listed(table.names)}){hint}")
        raise Failure(f"{takes}, but --columns names {len(columns)}")
    return columns


def pose(table: DataTable, columns: Sequence[int], model: str) -> LinearProblem:
    """Return the problem that the chosen columns pose; Failure if a cell is bad or there are too few rows."""
    values = table.numbers(columns)
    needed = len(columns) + 1
    if len(values) < needed:
        raise Failure(
            f"a {model} with {len(columns)} parameters needs at least {needed} rows of data, "
            f"but {table.source} has {len(values)}"
        )
    if model == "line":
        return line(values[:, 0], values[:, 1])
    if model == "plane":
        return plane(values[:, 0], values[:, 1], values[:, 2])
    return hyperplane(values[:, :-1], values[:, -1])


def _parse_npy(content: bytes, source: str) -> DataTable:
    try:
        array = np.load(io.BytesIO(content), allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise Failure(f"{source} is not a readable NPY file: {error}") from None
    if array.ndim != 2 or array.dtype.kind not in "biuf":
        raise Failure(
            f"{source} must hold a 2-D array of real numbers, but its shape is {array.shape} "
            f"and its dtype {array.dtype}"
        )
    if array.size == 0:
        raise Failure(f"{source} holds no data: its shape is {array.shape}")
    names = tuple(f"column {column + 1}" for column in range(array.shape[1]))
    return DataTable(source, names, array.astype(np.float64), [f"row {row + 1}" for row in range(len(array))])


def _parse_csv(text: str, source: str, header: bool | None = None) -> DataTable:
    lines: list[tuple[int, str]] = []
    remark = ""  # the comment just above the first line
    for number, content in enumerate(text.splitlines(), start=1):
        if content.lstrip().startswith("#"):
            remark = remark if lines else content
        elif content.strip():
            lines.append((number, content))
    if not lines:
        raise Failure(f"{source} holds no data")
    delimiter = _sniff([content for _, content in lines[:SNIFFED_LINES]])
    rows = [_split(content, delimiter) for _, content in lines]
    width = len(rows[0])
    for (number, _), row in zip(lines, rows, strict=True):
        if len(row) != width:
            raise Failure(f"{source}, line {number}: {_cells(len(row))}, but line {lines[0][0]} has {width}")
    # A first line with any number in it is data: then a typing error in it is reported, not taken for a name.
    guessed = header is None
    if header is None:
        header = all(_number(cell) is None for cell in rows[0])
    if not header:
        names = _names_in(remark, delimiter, width)
    else:
        names = rows.pop(0)
        lines.pop(0)
        if not rows:
            raise Failure(f"{source} holds no data, only the line {', '.join(names)!r}")
    named = tuple(name or f"column {column + 1}" for column, name in enumerate(names))
    return DataTable(source, named, rows, [f"line {number}" for number, _ in lines], guessed and not header)


def _looks_like_names(rows: list[list[str]]) -> bool:
    """Whether a first line of numbers may be meant as names: all different whole ones (years, or 0, 1, 2) above others.

    In each column most of the numbers below must be written otherwise, as 3.5 or 1e3.
    """
    first, others = rows[0], rows[1:SNIFFED_LINES]
    whole = all(cell.isdecimal() for cell in first) and len(set(first)) == len(first)
    decimal = [sum(not row[column].lstrip("+-").isdecimal() for row in others) for column in range(len(first))]
    return whole and bool(others) and min(decimal) > len(others) / 2


def _names_in(remark: str, delimiter: str, width: int) -> list[str]:
    """Return the names that a comment above the data gives, as NumPy's savetxt writes them, or empty ones."""
    names = _split(remark.strip().lstrip("#").strip(), delimiter) if remark else []
    if len(names) != width or any(not name or _number(name) is not None for name in names):
        return [""] * width
    return names


def _split(content: str, delimiter: str) -> list[str]:
    if delimiter == " ":
        content = content.replace("\t", " ").strip()
    cells = next(csv.reader([content], delimiter=delimiter, skipinitialspace=True))
    return [cell.strip() for cell in cells]


def _sniff(lines: list[str]) -> str:
    """Return the delimiter that cuts all lines alike; of several, the one that leaves most numbers."""
    best, best_score = " ", (False, 0)
    for delimiter in DELIMITERS:
        rows = [_split(content, delimiter) for content in lines]
        if max(len(row) for row in rows) == 1:
            continue
        alike = len({len(row) for row in rows}) == 1
        if alike and delimiter == ";":  # "1,5;2,5": the commas are decimal, and would leave more numbers
            return delimiter
        score = (alike, sum(_number(cell) is not None for row in rows for cell in row))
        if score > best_score:
            best, best_score = delimiter, score
    return best


def _number(cell: str | np.float64) -> float | None:
    if isinstance(cell, str) and "_" in cell:  # Python reads 1_000 as a number, nobody else does
        return None
    try:
        return float(cell)
    except ValueError:
        return None


def _fault(cell: str | np.float64) -> str:
    if isinstance(cell, str) and not cell:
        return "the cell is empty"
    if _number(cell) is not None:
        return f"{str(cell)!r} is not a finite number"
    hint = ""
    if isinstance(cell, str) and _number(cell.replace(",", ".")) is not None:
        hint = " (decimal commas are not read: write a point)"
    return f"{cell!r} is not a number{hint}"


def _find_column(table: DataTable, wanted: str) -> int:
    if wanted in table.names:
        if table.names.count(wanted) > 1:
            raise Failure(f"{table.source} has more than one column {wanted!r}: choose it by its number")
        return table.names.index(wanted)
    width = len(table.names)
    if wanted.isdecimal() and 1 <= int(wanted) <= width:
        return int(wanted) - 1
    raise Failure(
        f"{table.source} has no column {wanted!r}: its columns are {_listed(table.names)}, numbered from 1 to {width}"
    )


def _cells(count: int) -> str:
    return "1 cell" if count == 1 else f"{count} cells"


def _listed(names: Sequence[str]) -> str:
    shown = ", ".join(names[:8])
    return shown if len(names) <= 8 else f"{shown}, ..."
