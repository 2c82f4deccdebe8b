from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from core.errors import InputError
from core.gps_record import gps_columns, read_gps
from core.project import GpsInput


def write(folder: Path, text: str) -> Path:
    file = folder / "gps.csv"
    file.write_text(text, encoding="utf-8")
    return file


def settings(**names: str) -> GpsInput:
    return GpsInput(file="gps.csv", **names)  # type: ignore[arg-type]


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_reads_named_columns_and_passes_over_the_rest(tmp_path: Path, separator: str) -> None:
    rows = ["\ufeff# station CENT", "time_s,up_m,north_m,east_m", "0.0,9,2.5,1.5", "", "0.1,9,2.6,1.6", "0.2,x,2.7,1.7"]
    file = write(tmp_path, "\n".join([*rows, "0.3,9,2.8,1.8"]).replace(",", separator) + "\n")
    record = read_gps(file, settings())
    np.testing.assert_allclose(record.time_s, [0, 0.1, 0.2, 0.3])
    np.testing.assert_allclose(record.position_m, [[1.5, 2.5], [1.6, 2.6], [1.7, 2.7], [1.8, 2.8]])
    assert not record.position_m.flags.writeable
    assert record.name == str(file)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("t,e,n\n0,1,2\n", r'gps\.csv: has no column "time_s" \(found "t", "e", "n"\).*inputs\.gps\.time'),
        ("time_s,east_m,north_m\n0,1,2\n0.1,oops,2\n", r'line 3: "east_m" is "oops", not a number; correct or remove'),
        ("time_s,east_m,north_m\n0,1,2\n0.1,1\n", r'line 3: "north_m" is empty'),
        ("time_s,east_m,north_m\n0,1,2\n0.1,1,nan\n", r'line 3: "north_m" is "nan", not a number'),
        ("time_s,east_m,north_m\n0,1,2\n1,1,2\n", r"has 2 positions; at least four"),
        (
            "time_s,east_m,north_m\n0,1,2\n2,1,2\n\n1,1,2\n3,1,2\n",
            r'line 5: "time_s" is 1, not after the line before \(2\)',
        ),
        (
            "time_s,east_m,north_m\n0,1,2\n# receiver on\n1700000000,1,2\n1700000000.5,1,2\n1700000001,1,2\n",
            r"line 4: its time is 1\.7e\+09 s after that of the line before, 0 s, .* 0\.5 s apart; correct the times",
        ),
        (
            "time_s,east_m,north_m\n0,1,2\n12:00 o'clock,1,2\n",
            r'line 3: "time_s" is "12:00 o\'clock", not a number or a time such as 2026-03-01T12:00:00\.250Z',
        ),
        (
            "time_s,east_m,north_m\n12:00:00,1,2\n12:00:01,1,2\n2.5,1,2\n12:00:03,1,2\n",
            r'line 4: "time_s" is a number, but a time of day in the lines before; write all alike',
        ),
        (
            "time_s,east_m,north_m\n2026-03-01 12:00,1,2\n2026-03-01 12:01Z,1,2\n2026-03-01 12:02,1,2\n"
            "2026-03-01 12:03,1,2\n",
            r"line 3: .* is a date and time with its time zone, but a date and time in the lines before",
        ),
        (
            "time_s,east_m,north_m\n12:00:01,1,2\n12:00:03,1,2\n12:00:02,1,2\n12:00:04,1,2\n",
            r'line 4: "time_s" is 1, not after the line before \(2\)',
        ),
        ("", r"is empty"),
        ("time_s,east_m,east_m\n0,1,2\n", r'gps\.csv: has several columns "east_m"; give each a name of its own'),
        ("time_s,east_m,north_m\n0,0,1,5,2,5\n", r"line 2: holds 6 values under 3 names of columns; .* decimal points"),
        ("time_s,east_m,north_m\n0,1e300,2\n", r'line 2: "east_m" is "1e300", not a coordinate in metres'),
        ("time_s;east_m;north_m\n0;1.234,5;2\n", r'line 2: "east_m" is "1\.234,5", not a number'),
        ('time_s,east_m,north_m\n0,"' + 200_000 * "9" + '",2\n', r"line 2: is no line of a table"),
        (
            "time_s,east_m,north_m\n1700000000.5,1,2\n1700000000.25,1,2\n1700000001,1,2\n1700000002,1,2\n",
            r"is 1700000000\.25, not after the line before \(1700000000\.5\)",
        ),
    ],
)
def test_bad_records_are_refused_by_line(tmp_path: Path, body: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_gps(write(tmp_path, body), settings())


@pytest.mark.parametrize(
    "start",
    [
        "2026-03-01T23:59:59.{}Z",
        "2026-03-01 23:59:59.{}",
        "2026-03-01T23:59:59,{}+09:00",
        "20260301T235959.{}Z",
        "23:59:59.{}",
    ],
)
def test_dates_and_times_of_day_count_from_the_first_to_the_microsecond(tmp_path: Path, start: str) -> None:
    midnight = start.replace("23:59:59", "00:00:00").replace("235959", "000000").replace("03-01", "03-02")
    midnight = midnight.replace("0301", "0302")
    texts = [start.format("25"), start.format("250001"), start.format("999999"), midnight.format("000")]
    body = "\n".join(["time_s;east_m;north_m", *(f"{text};1;2" for text in texts)])
    time_s = read_gps(write(tmp_path, body), settings()).time_s
    assert time_s.tolist() == [0.0, 1e-6, 0.749999, 0.75]


def test_a_record_may_have_a_gap_of_days(tmp_path: Path) -> None:
    days_s = 3 * 86_400
    body = "time_s,east_m,north_m\n" + "".join(f"{time_s},1,2\n" for time_s in (0, 0.1, 0.2, days_s, days_s + 0.1))
    assert len(read_gps(write(tmp_path, body), settings()).time_s) == 5


def test_missing_and_binary_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"not found; correct inputs\.gps\.file"):
        read_gps(tmp_path / "none.csv", settings())
    (tmp_path / "gps.csv").write_bytes(b"\x89PNG\r\n\x1a\n\x00\x81")
    with pytest.raises(InputError, match="cannot be read as text"):
        read_gps(tmp_path / "gps.csv", settings())


RECORD = "Zeit_s,Ost_m,Höhe_m,Nord_m\n0.0,1.5,9.0,2.5\n0.1,1.6,9.0,2.6\n0.2,1.7,9.0,2.7\n0.3,1.8,9.0,2.8\n"


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "latin-1"])
def test_any_usual_encoding_is_read(tmp_path: Path, encoding: str) -> None:
    file = tmp_path / "gps.csv"
    file.write_bytes(RECORD.encode(encoding))
    assert gps_columns(file) == ["Zeit_s", "Ost_m", "Höhe_m", "Nord_m"]
    record = read_gps(file, settings(time="Zeit_s", x="Ost_m", y="Nord_m"))
    np.testing.assert_allclose(record.position_m, [[1.5, 2.5], [1.6, 2.6], [1.7, 2.7], [1.8, 2.8]])


@pytest.mark.parametrize("separator", [";", "\t", " "])
def test_numbers_may_have_decimal_commas_where_commas_separate_no_columns(tmp_path: Path, separator: str) -> None:
    file = write(tmp_path, RECORD.replace(",", separator).replace(".", ","))
    record = read_gps(file, settings(time="Zeit_s", x="Ost_m", y="Nord_m"))
    np.testing.assert_allclose(record.time_s, [0, 0.1, 0.2, 0.3])
    np.testing.assert_allclose(record.position_m[:, 1], [2.5, 2.6, 2.7, 2.8])


def test_one_column_is_not_taken_for_two_things(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="takes two of time, x and y from one column; name three columns"):
        read_gps(write(tmp_path, RECORD), settings(time="Zeit_s", x="Ost_m", y="Ost_m"))
