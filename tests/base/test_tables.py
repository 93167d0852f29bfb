"""Tables: the same rows in each form that spreadsheets and data frames write, and errors with line and column."""

import pytest

from catstream.base.tables import read_table, write_table
from catstream.errors import VideoError

FORMS = {
    "commas": b"name,x,frame\ncam.mp4,40.5,3\nb,7,0\n",
    "semicolons and a decimal comma": b"name;x;frame\r\ncam.mp4;40,5;3\r\nb;7;0\r\n",
    "tabs, empty cells, a byte order mark": b"\xef\xbb\xbfname\tx\tframe\t\ncam.mp4\t40.5\t3\t\nb\t7\t0\t\n",
    "Unicode text of Excel": "name\tx\tframe\r\ncam.mp4\t40,5\t3\r\nb\t7\t0\r\n".encode("utf-16"),
    "a separator in the first line": b"sep=;\nname;x;frame\ncam.mp4;40,5;3\nb;7;0\n",
    "blanks, quotes and capitals": b'\n Name , "X", Frame\n cam.mp4 , "40,5" , 3\n\nb, 7, 0',
    "rows without a value": b"name,x,frame\n,,\ncam.mp4,40.5,3\n\n , ,\nb,7,0\n,,\n",
    "an index, other orders, whole numbers with zeros": b",frame,name,note,x\n0,3.0,cam.mp4,,40.50\n1,0.0,b,n,7.0\n",
    "line ends of old Macs": b"name,x,frame\rcam.mp4,40.5,3\rb,7,0\r",
}


def read(path):
    return read_table(
        path, ("name", "x", "frame"), lambda row: (row.text("name"), row.number("x"), row.integer("frame"))
    )


@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
def test_table_is_read_in_each_form(tmp_path, form):
    (tmp_path / "t.csv").write_bytes(form)
    assert read(tmp_path / "t.csv") == [("cam.mp4", 40.5, 3), ("b", 7.0, 0)]


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (b"name,x,frame\na,1,2\n\nb,wide,3\n", "line 4: column x: expected a number, got 'wide'"),
        (b"name,x,frame\na,1,2.5\n", "line 2: column frame: expected a whole number, got '2.5'"),
        (b"name,x,frame\na,nan,2\n", "line 2: column x: expected a number, got 'nan'"),
        (b'name,x,frame\na,"1,234",2\n', "line 2: column x: expected a number, got '1,234'"),
        (b"name;x;frame\na;1.234,5;2\n", "line 2: column x: expected a number, got '1.234,5'"),
        (b"name,x,frame\na,1\n", "line 2: column frame: expected a number, got ''"),
        (b"a,1,2\n", "lacks the column name, x, frame: its first line has to name the columns name,x,frame"),
        ("name,x,frame\nZoë,1,2".encode("cp1252"), "(its text is not UTF-8): pass a CSV file with the columns name,x"),
    ],
)
def test_error_names_the_line_and_the_column(tmp_path, rows, message):
    (tmp_path / "t.csv").write_bytes(rows)
    with pytest.raises(VideoError) as error:
        read(tmp_path / "t.csv")
    assert message in str(error.value)


def test_table_is_read_as_it_was_written(tmp_path):
    rows = [("a;b,c\td", 1.5, 2), ('"', -3.0, 0)]
    write_table(tmp_path / "new" / "t.csv", ("name", "x", "frame"), rows)
    assert read(tmp_path / "new" / "t.csv") == rows
