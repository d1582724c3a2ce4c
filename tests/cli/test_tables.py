import io

import numpy as np
import pytest

from maxcon.cli.errors import Failure
from maxcon.cli.tables import choose_columns, pose, read_table

ROWS = [[1.0, 2.0], [3.0, -4.5], [5e3, 0.25]]


def write(tmp_path, content, name="table.csv"):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return str(path)


def read(tmp_path, content):
    return read_table(write(tmp_path, content))


def values(table):
    return table.numbers(range(len(table.names))).tolist()


@pytest.mark.parametrize(
    "text",
    [
        "1,2\n3,-4.5\n5e3,.25\n",
        "1;2\n3;-4.5\n5e3;.25",
        "1\t2\r\n3\t-4.5\r\n5e3\t.25\r\n",
        "1 2\n3 -4.5\n5e3 .25\n",
        "  1    2\n  3 \t -4.5  \n5e3  .25\n",
        "1, 2\n3,   -4.5\n5e3, .25\n",
        '"1","2"\n"3","-4.5"\n"5e3",".25"\n',
        "\ufeff1,2\n\n3,-4.5\n# a remark\n\n5e3,.25\n\n",
        "# what it is\n# 7 8 9\n1,2\n3,-4.5\n5e3,.25\n",
        "a,\tb\n1,\t2\n3,\t-4.5\n5e3,\t.25\n",
    ],
)
def test_same_numbers_however_written(tmp_path, text):
    assert values(read(tmp_path, text)) == ROWS


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("x,y\n1,2\n", ("x", "y")),
        ("x;y\n1;2\n", ("x", "y")),
        ('"log light" "log temp"\n1 2\n', ("log light", "log temp")),
        ("log light, log temp\n1, 2\n", ("log light", "log temp")),
        (",y\n1,2\n", ("column 1", "y")),
        ("1,2\n3,4\n", ("column 1", "column 2")),
        ("# x,y\n1,2\n", ("x", "y")),
        ("# title\n# x y\n1 2\n", ("x", "y")),
        ("# x,y\n# units vary\n1,2\n", ("column 1", "column 2")),  # only the line just above can hold names
        ("# a b c\n1 2\n", ("column 1", "column 2")),
        ("# 1 2\n1 2\n", ("column 1", "column 2")),
        ("1,2\n# x,y\n3,4\n", ("column 1", "column 2")),
    ],
)
def test_names(tmp_path, text, names):
    assert read(tmp_path, text).names == names


def test_semicolons_win_over_decimal_commas(tmp_path):
    table = read(tmp_path, "x;y\n1,5;2,5\n2,5;3,5\n")
    assert table.names == ("x", "y")
    with pytest.raises(Failure, match=r"line 2, column 1 \(x\): '1,5' is not a number \(decimal commas"):
        values(table)


def test_a_typing_error_in_the_first_line_is_no_header(tmp_path):
    with pytest.raises(Failure, match=r"table.csv, line 1, column 1: '1o' is not a number"):
        values(read(tmp_path, "1o,2\n3,4\n"))


@pytest.mark.parametrize(
    ("cell", "fault"),
    [
        ("abc", "'abc' is not a number"),
        ("", "the cell is empty"),
        ("nan", "'nan' is not a finite number"),
        ("NaN", "'NaN' is not a finite number"),
        ("-inf", "'-inf' is not a finite number"),
        ("1_000", "'1_000' is not a number"),
        ("1e999", "'1e999' is not a finite number"),
        ("0x10", "'0x10' is not a number"),
    ],
)
def test_a_bad_cell_is_named(tmp_path, cell, fault):
    table = read(tmp_path, f"# remark\nx,y\n1,2\n\n3,{cell}\n")
    with pytest.raises(Failure) as error:
        table.numbers([0, 1])
    assert str(error.value) == f"{table.source}, line 5, column 2 (y): {fault}"
    assert table.numbers([0]).tolist() == [[1.0], [3.0]]  # an unused column may hold anything


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "holds no data"),
        (b"# only\n\n# remarks\n", "holds no data"),
        (b"x,y\n", "holds no data, only the line 'x, y'"),
        (b"1,2\n3,4,5\n", "line 2: 3 cells, but line 1 has 2"),
        (b"1 2\n\n# r\n3\n", "line 4: 1 cell, but line 1 has 2"),
        (b"\xff\xfe1\x00", "neither an NPY file nor UTF-8 text"),
        (b"PK\x03\x04xyz", "is a zip archive"),
        (b"\x93NUMPY\x01\x00garbage", "is not a readable NPY file"),
    ],
)
def test_unreadable(tmp_path, content, message):
    with pytest.raises(Failure, match=message):
        read(tmp_path, content)


def test_no_file(tmp_path):
    with pytest.raises(Failure, match="there is no file"):
        read_table(str(tmp_path / "none.csv"))
    with pytest.raises(Failure, match="is a folder"):
        read_table(str(tmp_path))


def npy(array):
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.int16, ">f8", np.bool_])
@pytest.mark.parametrize("order", ["C", "F"])
def test_npy(tmp_path, dtype, order):
    array = np.array([[1, 0], [1, 1], [0, 1]]).astype(dtype, order=order)
    table = read(tmp_path, npy(array))  # told by its first bytes, whatever the file is called
    assert table.names == ("column 1", "column 2")
    np.testing.assert_array_equal(table.numbers([0, 1]), array.astype(float))


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.zeros(3), r"2-D array of real numbers, but its shape is \(3,\)"),
        (np.zeros((2, 2), dtype=complex), "its dtype complex128"),
        (np.array([["a", "b"]]), "its dtype <U1"),
        (np.zeros((0, 2)), "holds no data"),
    ],
)
def test_npy_of_another_kind(tmp_path, array, message):
    with pytest.raises(Failure, match=message):
        read(tmp_path, npy(array))


def test_npy_never_unpickles(tmp_path):
    buffer = io.BytesIO()
    np.save(buffer, np.array([[{}, 1]], dtype=object), allow_pickle=True)
    with pytest.raises(Failure, match="not a readable NPY file"):
        read(tmp_path, buffer.getvalue())


def test_npy_names_the_row_of_a_nan(tmp_path):
    array = np.ones((4, 3))
    array[2, 1] = np.nan
    table = read(tmp_path, npy(array))
    with pytest.raises(Failure, match=r"row 3, column 2: 'nan' is not a finite number"):
        table.numbers([0, 1, 2])
    assert table.numbers([0, 2]).shape == (4, 2)


@pytest.mark.parametrize(
    ("wanted", "model", "columns"),
    [
        (None, "hyperplane", [0, 1, 2, 3]),
        ("a,b", "line", [0, 1]),
        ("4,1", "line", [3, 0]),
        ("b, 4, a", "plane", [1, 3, 0]),
        ("a,b,c,d", "hyperplane", [0, 1, 2, 3]),
    ],
)
def test_columns(tmp_path, wanted, model, columns):
    assert choose_columns(read(tmp_path, "a,b,c,d\n1,2,3,4\n"), wanted, model) == columns


@pytest.mark.parametrize(
    ("wanted", "model", "message"),
    [
        ("b,q", "line", "has no column 'q': its columns are a, b, a, numbered from 1 to 3"),
        ("1,4", "line", "has no column '4'"),
        ("1,0", "line", "has no column '0'"),
        ("1,-1", "line", "has no column '-1'"),
        ("1,", "line", "has no column ''"),
        ("2,2", "line", r"names column 2 \(b\) twice"),
        ("b,2", "line", r"names column 2 \(b\) twice"),
        ("a,b", "line", "more than one column 'a'"),
        ("1,2,3", "line", "a line takes 2 columns, the dependent one last, but --columns names 3"),
        ("1", "hyperplane", "a hyperplane takes at least 2 columns"),
        (None, "line", r"has 3 columns \(a, b, a\); choose with --columns"),
    ],
)
def test_columns_that_do_not_fit(tmp_path, wanted, model, message):
    table = read(tmp_path, "a,b,a\n1,2,3\n")
    with pytest.raises(Failure, match=message):
        choose_columns(table, wanted, model)


def test_pose(tmp_path):
    table = read(tmp_path, "a,b,c\n1,2,3\n4,5,6\n7,8,10\n0,0,1\n")
    line = pose(table, [2, 0], "line")
    assert (line.family, line.A[:, 0].tolist(), line.b.tolist()) == ("line", [3, 6, 10, 1], [1, 4, 7, 0])
    plane = pose(table, [0, 1, 2], "plane")
    assert (plane.family, plane.A.tolist()[0], plane.b.tolist()) == ("plane", [1, 2, 1], [3, 6, 10, 1])
    hyperplane = pose(table, [1, 0, 2], "hyperplane")
    assert (hyperplane.family, hyperplane.A.tolist()[1]) == ("hyperplane", [5, 4, 1])


def test_too_few_rows(tmp_path):
    table = read(tmp_path, "1,2,3\n4,5,6\n7,8,9\n")
    with pytest.raises(Failure, match=r"a plane with 3 parameters needs at least 4 rows of data, but .* has 3"):
        pose(table, [0, 1, 2], "plane")


def test_a_header_of_numbers(tmp_path, capsys):
    file = write(tmp_path, "2019,2020\n1.5,2\n2.5,4.5\n3.5,6.5\n")
    table = read_table(file, header=True)
    assert table.names == ("2019", "2020")
    assert values(table) == [[1.5, 2.0], [2.5, 4.5], [3.5, 6.5]]
    assert capsys.readouterr().err == ""
    table = read_table(file)
    assert len(values(table)) == 4
    assert "line 1 of " in (note := capsys.readouterr().err)
    assert "(2019, 2020) is taken for data; --header takes it for names" in note
    table = read_table(file, header=False)
    assert len(values(table)) == 4
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    "text",
    [
        "1,2\n3,4\n5,6\n",  # whole numbers throughout
        "0,1\n1,2.5\n2,3.5\n",  # an x that is a count
        "0,0\n1.5,2.5\n2.5,3.5\n",  # no two columns have one name
        "0.5,1\n1.5,2.5\n2.5,3.5\n",
        "1950,0.44\n1951,0.47\n",
        "1,2\n",
    ],
)
def test_no_note_where_the_first_line_looks_like_the_others(tmp_path, capsys, text):
    values(read(tmp_path, text))
    assert capsys.readouterr().err == ""


def test_a_word_in_a_first_line_with_numbers(tmp_path):
    with pytest.raises(Failure, match=r"line 1, column 1: 'id' is not a number; --header takes this line for names"):
        values(read(tmp_path, "id,2019\n1,2\n3,4\n"))
    with pytest.raises(Failure, match=r"line 1, column 1: 'id' is not a number$"):
        values(read_table(write(tmp_path, "id,2019\n1,2\n"), header=False))
    with pytest.raises(Failure, match=r"line 2, column 2: 'x' is not a number$"):
        values(read(tmp_path, "1,2\n3,x\n"))


def test_words_are_data_where_there_is_no_header(tmp_path):
    with pytest.raises(Failure, match=r"line 1, column 1: 'a' is not a number"):
        values(read_table(write(tmp_path, "a,b\n1,2\n"), header=False))


def test_a_header_alone_or_in_an_array(tmp_path):
    with pytest.raises(Failure, match="holds no data, only the line '1, 2'"):
        read_table(write(tmp_path, "1,2\n"), header=True)
    np.save(tmp_path / "a.npy", np.ones((3, 2)))
    with pytest.raises(Failure, match="is an NPY file, which has no header line"):
        read_table(str(tmp_path / "a.npy"), header=True)
