from __future__ import annotations

import builtins
import struct

import laspy
import numpy as np
import pytest

from core.cloud import Cloud, pick, read_cloud, thin
from core.errors import InputError
from tests.scanned_site import ORIGIN, ROOF_M, site


@pytest.fixture(scope="module")
def building() -> Cloud:
    return site()


SAMPLE = ORIGIN + np.random.default_rng(3).uniform(-10, 10, (500, 3)).round(3)
COLOURS = np.random.default_rng(4).integers(0, 256, (500, 3)).astype(np.uint8)
COLOURS_16_BIT = COLOURS.astype(np.uint16) * 257
STRENGTH = np.random.default_rng(5).integers(0, 4000, 500).astype(np.uint16)


def write_las(file, xyz=SAMPLE, point_format=2, colours=COLOURS_16_BIT, **others):
    header = laspy.LasHeader(point_format=point_format, version="1.4" if point_format > 5 else "1.2")
    header.scales, header.offsets = [0.001] * 3, np.floor(ORIGIN)
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    las.intensity = STRENGTH[: len(xyz)]
    if colours is not None:
        las.red, las.green, las.blue = colours[: len(xyz)].astype(np.uint16).T
    for name, value in others.items():
        setattr(las, name, value)
    las.write(file)


def write_ply(file, encoding="binary_little_endian", kind="double", count=500):
    order = ">" if encoding == "binary_big_endian" else "<"
    head = f"ply\nformat {encoding} 1.0\ncomment made here\nelement vertex {count}\n" + "".join(
        f"property {kind} {axis}\n" for axis in "xyz"
    )
    head += "".join(f"property uchar {channel}\n" for channel in ("red", "green", "blue"))
    head += "property ushort intensity\nelement face 0\nproperty list uchar int vertex_indices\nend_header\n"
    if encoding == "ascii":
        rows = np.column_stack([SAMPLE, COLOURS, STRENGTH])
        body = "\n".join(" ".join(f"{value:.12g}" for value in row) for row in rows).encode() + b"\n"
    else:
        number = {"double": "f8", "float": "f4"}[kind]
        dtype = [(axis, order + number) for axis in "xyz"] + [(c, "u1") for c in "rgb"] + [("i", order + "u2")]
        table = np.zeros(500, dtype)
        for axis in range(3):
            table["xyz"[axis]], table["rgb"[axis]] = SAMPLE[:, axis], COLOURS[:, axis]
        table["i"] = STRENGTH
        body = table.tobytes()
    file.write_bytes(head.encode() + body)


def write_pcd(file, encoding="binary", packed=True):
    head = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z rgb intensity\nSIZE 8 8 8 4 4\nTYPE F F F F F\nCOUNT 1 1 1 1 1\n"
        f"WIDTH 501\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 501\nDATA {encoding}\n"
    )
    whole = (COLOURS.astype(np.uint32) << np.array([16, 8, 0], np.uint32)).sum(axis=1).astype(np.uint32)
    rows = np.zeros(501, [("x", "f8"), ("y", "f8"), ("z", "f8"), ("rgb", "f4"), ("i", "f4")])
    for axis in range(3):
        rows["xyz"[axis]][:500] = SAMPLE[:, axis]
        rows["xyz"[axis]][500] = np.nan
    rows["rgb"][:500], rows["i"][:500] = whole.view(np.float32), STRENGTH
    if encoding == "ascii":
        text = (f"{r['x']:.12g} {r['y']:.12g} {r['z']:.12g} {r['rgb']:.9g} {r['i']:.9g}" for r in rows)
        file.write_bytes(head.encode() + "\n".join(text).encode() + b"\n")
    else:
        file.write_bytes(head.encode() + rows.tobytes())


def write_text(file, head="", order="xyzirgb", separator=" "):
    columns = {**dict(zip("xyz", SAMPLE.T, strict=True)), **dict(zip("rgb", COLOURS.T, strict=True)), "i": STRENGTH}
    rows = np.column_stack([columns[name] for name in order])
    file.write_text(head + "\n".join(separator.join(f"{value:.12g}" for value in row) for row in rows) + "\n")


def write_e57(file):
    pye57 = pytest.importorskip("pye57")
    table = {f"cartesian{axis}": SAMPLE[:, i] for i, axis in enumerate("XYZ")}
    table |= {f"color{name}": COLOURS[:, i] for i, name in enumerate(("Red", "Green", "Blue"))}
    with pye57.E57(str(file), mode="w") as e57:
        e57.write_scan_raw({**table, "intensity": STRENGTH.astype(np.float64)})


class Holed(np.ndarray):
    """Coordinates whose bounds pye57 can write although some are no numbers, or there are none."""

    def min(self):
        return float(np.nan_to_num(np.asarray(self)).min(initial=0))

    def max(self):
        return float(np.nan_to_num(np.asarray(self)).max(initial=0))


def write_scans(file, *scans, **more):
    """Write an E57 file of bare scans, each (N, 3)."""
    pye57 = pytest.importorskip("pye57")
    with pye57.E57(str(file), mode="w") as e57:
        for scan in scans:
            e57.write_scan_raw({f"cartesian{axis}": scan[:, i].view(Holed) for i, axis in enumerate("XYZ")} | more)


def holed(value):
    """The sample about the origin, a few of its points with this coordinate."""
    points = SAMPLE - ORIGIN
    points[5:20, 1] = value
    return points


WRITERS = {
    "a.las": write_las,
    "a.laz": write_las,
    "b.laz": lambda file: write_las(file, point_format=7),
    "a.ply": write_ply,
    "b.ply": lambda file: write_ply(file, "ascii"),
    "c.ply": lambda file: write_ply(file, "binary_big_endian"),
    "a.pcd": write_pcd,
    "b.pcd": lambda file: write_pcd(file, "ascii"),
    "a.pts": lambda file: write_text(file, "500\n"),
    "a.csv": lambda file: write_text(file, "X,Y,Z,Intensity,R,G,B\n", separator=","),
    "b.csv": lambda file: write_text(file, "R;G;B;East;North;Height;intensity\n", "rgbxyzi", ";"),
    "a.txt": lambda file: write_text(file, "# made here\n//X Y Z Intensity R G B\n"),
    "a.xyz": write_text,
    "a.e57": write_e57,
}


@pytest.mark.parametrize("name", WRITERS)
def test_every_format_keeps_millimetres_in_utm(tmp_path, name):
    WRITERS[name](tmp_path / name)
    cloud = read_cloud(tmp_path / name)
    np.testing.assert_allclose(cloud.world_m, SAMPLE, atol=1e-6)
    np.testing.assert_array_equal(cloud.colour, COLOURS)
    np.testing.assert_array_equal(cloud.intensity, STRENGTH)
    np.testing.assert_array_equal(cloud.origin_m, np.round(cloud.origin_m))
    assert np.abs(cloud.origin_m - ORIGIN).max() < 3
    assert cloud.notes == ()


def test_compressed_pcd_is_read_with_open3d(tmp_path):
    try:
        import open3d
    except (ImportError, OSError):
        pytest.skip("open3d cannot be loaded here")
    points = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(SAMPLE - ORIGIN))
    open3d.io.write_point_cloud(tmp_path / "c.pcd", points, compressed=True)
    np.testing.assert_allclose(read_cloud(tmp_path / "c.pcd").world_m, SAMPLE - ORIGIN, atol=1e-5)


def test_without_open3d_one_sentence_names_the_packages(tmp_path, monkeypatch):
    (tmp_path / "c.pcd").write_text(
        "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        "WIDTH 1\nHEIGHT 1\nPOINTS 0\nDATA binary_compressed\n\0\0\0\0\0\0\0\0"
    )
    original = builtins.__import__

    def without(name, *rest):
        if name == "open3d":
            raise OSError("libEGL.so.1: cannot open shared object file")
        return original(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(InputError, match=r"libegl1 libgl1 libx11-6 libusb-1\.0-0 libudev1 libidn2-0"):
        read_cloud(tmp_path / "c.pcd")
    write_ply(tmp_path / "a.ply")
    assert len(read_cloud(tmp_path / "a.ply")) == 500


def test_text_without_names_is_understood_by_its_number_of_columns(tmp_path):
    for order, colour, intensity in (("xyz", False, False), ("xyzi", False, True), ("xyzrgb", True, False)):
        write_text(tmp_path / "a.xyz", order=order)
        cloud = read_cloud(tmp_path / "a.xyz")
        assert (cloud.colour is not None, cloud.intensity is not None) == (colour, intensity)
    normals = np.column_stack([SAMPLE, np.tile([0.0, -0.6, 0.8], (500, 1))])
    np.savetxt(tmp_path / "n.xyz", normals, fmt="%.6f")
    assert read_cloud(tmp_path / "n.xyz").colour is None


def test_lines_without_points_are_counted_and_end_no_file(tmp_path, monkeypatch):
    monkeypatch.setattr("core.point_files._TEXT_CHUNK_LINES", 4)
    rows = ["1 2 3", "# one", "", "4 5 6", "# two", "", "# three", "", "7 8 9"]
    (tmp_path / "a.xyz").write_text("\n".join(rows))
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.xyz").world_m[:, 0], [1, 4, 7])
    (tmp_path / "b.xyz").write_text("\n".join([*rows, "", "1 here 2"]))
    with pytest.raises(InputError, match="line 11 does not hold 3 numbers"):
        read_cloud(tmp_path / "b.xyz")


def test_colours_may_be_parts_of_one(tmp_path):
    for head in ("", "//X Y Z Rf Gf Bf\n"):
        np.savetxt(tmp_path / "a.txt", np.column_stack([SAMPLE, COLOURS / 255]), fmt="%.6f", header=head, comments="")
        np.testing.assert_array_equal(read_cloud(tmp_path / "a.txt").colour, COLOURS)


@pytest.mark.parametrize("separator", [";", " ", "\t"])
def test_decimal_commas_are_read_where_commas_separate_no_columns(tmp_path, separator):
    rows = [separator.join(f"{value:.3f}".replace(".", ",") for value in row) for row in SAMPLE]
    (tmp_path / "a.txt").write_text(separator.join(["X", "Y", "Z"]) + "\n" + "\n".join(rows))
    np.testing.assert_allclose(read_cloud(tmp_path / "a.txt").world_m, SAMPLE, atol=1e-6)


def test_names_of_columns_may_stand_in_a_comment(tmp_path):
    for mark in ("#", "//", "# ", "// "):
        (tmp_path / "a.txt").write_text(f"# made here\n{mark}x y z\n1 2 3\n4 5 6\n")
        assert len(read_cloud(tmp_path / "a.txt")) == 2


@pytest.mark.parametrize(
    "title",
    [
        "Site scan\n",
        "Everything beside the laboratory, scanned\n",
        "X Y Z Intensity R G B\n",
        "x,y,z,intensity,red,green,blue\n",
        "Points of the roof\nx y z intensity r g b\n",
        "X [m]; Y [m]; Z [m]; Intensity; R; G; B\n",
    ],
)
def test_a_first_line_without_numbers_is_a_title(tmp_path, title):
    write_text(tmp_path / "a.xyz", title)
    cloud = read_cloud(tmp_path / "a.xyz")
    np.testing.assert_allclose(cloud.world_m, SAMPLE, atol=1e-6)
    np.testing.assert_array_equal(cloud.colour, COLOURS)


def test_a_title_names_columns_in_any_order(tmp_path):
    for title, order in (("Northing(m),Easting(m),Elev(m)", "yxz"), ("Z Y X", "zyx"), ("I Z X Y", "izxy")):
        write_text(tmp_path / "a.txt", title + "\n", order)
        np.testing.assert_allclose(read_cloud(tmp_path / "a.txt").world_m, SAMPLE, atol=1e-6)


def test_noise_is_left_out_and_said_so(tmp_path):
    write_las(tmp_path / "a.las", classification=np.where(np.arange(500) < 20, 7, 2).astype(np.uint8))
    cloud = read_cloud(tmp_path / "a.las")
    assert len(cloud) == 480
    assert "20 points classified as noise were left out" in cloud.notes[0]


def test_points_of_e57_scans_that_are_none_are_left_out(tmp_path):
    kept = np.delete(SAMPLE - ORIGIN, np.s_[5:20], axis=0)
    write_scans(tmp_path / "nan.e57", holed(np.nan))
    invalid = np.zeros(500, np.int8)
    invalid[5:20] = 2
    write_scans(tmp_path / "invalid.e57", holed(0.0), cartesianInvalidState=invalid)
    write_scans(tmp_path / "empty.e57", np.empty((0, 3)), kept, np.empty((0, 3)))
    for name in ("nan.e57", "invalid.e57", "empty.e57"):
        np.testing.assert_allclose(read_cloud(tmp_path / name).world_m, kept, atol=1e-5)


def test_colour_or_intensity_that_says_nothing_is_none(tmp_path):
    write_las(tmp_path / "a.las", colours=np.zeros((500, 3)), intensity=np.full(500, 7, np.uint16))
    cloud = read_cloud(tmp_path / "a.las")
    assert cloud.colour is None
    assert cloud.intensity is None


def test_single_precision_is_noted(tmp_path):
    write_ply(tmp_path / "a.ply", kind="float")
    assert "in steps of 250 mm" in read_cloud(tmp_path / "a.ply").notes[0]


def cut(name, part):
    def write(file):
        WRITERS[name](file)
        file.write_bytes(file.read_bytes()[: int(part * file.stat().st_size)])

    return write


def with_nan(file):
    write_text(file, order="xyz")
    lines = file.read_text().splitlines()
    lines[41] = "nan 1 2"
    file.write_text("\n".join(lines))


def with_word(file):
    write_text(file, order="xyz")
    lines = file.read_text().splitlines()
    lines[41] = "651234 here 2"
    file.write_text("\n".join(lines))


def changed(name, old, new):
    """Return what writes the file `name` would be with one stretch of its bytes changed."""

    def write(file):
        whole = file.with_name(name)
        {".las": write_las, ".laz": write_las, ".ply": write_ply, ".pcd": write_pcd}[whole.suffix](whole)
        content = whole.read_bytes()
        assert old in content
        file.write_bytes(content.replace(old, new, 1))

    return write


def with_endless_chunk_table(file):
    write_las(file)
    content = bytearray(file.read_bytes())
    (points,) = struct.unpack_from("<I", content, 96)
    (table,) = struct.unpack_from("<q", content, points)
    struct.pack_into("<I", content, table + 4, 2**32 - 1)
    file.write_bytes(content)


def with_records(count, place=100, **how):
    """Return what writes a LAS file whose header promises so many records."""

    def write(file):
        write_las(file, **how)
        content = bytearray(file.read_bytes())
        struct.pack_into("<I", content, place, count)
        file.write_bytes(content)

    return write


REFUSED = [
    ("none.laz", lambda file: None, "not found"),
    ("empty.laz", lambda file: file.touch(), "is empty"),
    ("cloud.dwg", lambda file: file.write_text("x"), r"end in \.las, \.laz.*not in \.dwg"),
    ("words.laz", lambda file: file.write_text("no cloud at all" * 100), "damaged or no LAS file"),
    ("cut.las", cut("a.las", 0.6), "cut off|damaged"),
    ("cut.laz", cut("a.laz", 0.6), "cut off|damaged"),
    ("cut.ply", cut("a.ply", 0.6), r"ends after \d+ of 500 points"),
    ("cut2.ply", cut("b.ply", 0.6), r"ends after \d+ of 500 points|line \d+ does not hold 7 numbers"),
    ("cut3.ply", cut("a.ply", 0.003), "PLY header does not end"),
    ("cut.pcd", cut("a.pcd", 0.6), r"ends after \d+ of 501 points"),
    ("cut.pts", cut("a.pts", 0.6), r"ends after \d+ of 500 points|line \d+ does not hold 7 numbers"),
    ("cut.e57", cut("a.e57", 0.6), "damaged or no E57"),
    ("nopoints.las", lambda file: write_las(file, xyz=np.empty((0, 3)), colours=None), "0 points"),
    ("nopoints.csv", lambda file: file.write_text("x,y,z\n"), "holds no points"),
    ("nan.xyz", with_nan, r"1 points have coordinates that are not finite or .*, the first is point 41"),
    ("far.xyz", lambda file: file.write_text("1 2 3\n1e12 5 6\n"), r"no place on Earth, the first is point 1"),
    ("far.e57", lambda file: write_scans(file, holed(1e30)), "15 points have .*, the first is point 5"),
    ("nan.e57", lambda file: write_scans(file, np.full((9, 3), np.nan)), "no points with finite coordinates"),
    ("none.e57", lambda file: write_scans(file, np.empty((0, 3))), "holds no points; export it again"),
    ("far.las", changed("a.las", struct.pack("<d", 0.001), struct.pack("<d", 1e9)), "no place on Earth"),
    ("far.pcd", changed("a.pcd", struct.pack("<d", SAMPLE[7, 0]), struct.pack("<d", 1e30)), "no place on Earth"),
    ("utf16.xyz", lambda file: file.write_text("1 2 3\n", encoding="utf-16"), "is text in UTF-16; save it as UTF-8"),
    ("word.xyz", with_word, "line 42 does not hold 3 numbers"),
    ("two.csv", lambda file: file.write_text("1,2\n3,4\n"), "line 1 is neither names of columns"),
    ("north.csv", lambda file: file.write_text("Nord,Ost,Hoch\n1,2,3\n"), "line 1 has a word for each column but"),
    ("titles.txt", lambda file: file.write_text("Site\nscan\n1 2 3\n"), "line 2 is neither names of columns"),
    ("numbered.txt", lambda file: file.write_text("Scan 7\n1 2 3\n"), "line 1 is neither names of columns"),
    ("words.txt", lambda file: file.write_text("no cloud at all\n"), "holds no points"),
    ("five.csv", lambda file: file.write_text("1,2,3,4,5\n"), "has 5 columns without names"),
    ("comma.xyz", lambda file: file.write_text("12,345, 6,789, 0,012\n"), "line 1 has decimal commas"),
    ("commas.txt", lambda file: file.write_text("x y z\n12,345, 6,789, 0\n"), "line 2 has decimal commas"),
    ("noz.ply", lambda file: file.write_bytes(
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nproperty float y\nend_header\n"
        + struct.pack("<ff", 1, 2)), "has no column z"),
    ("head.pcd", lambda file: file.write_text("VERSION 0.7\nDATA ascii\n1 2 3\n"), "PCD header is incomplete"),
    ("cut.las", cut("a.las", 0.6), r"ends after \d+ of 500 points"),
    ("short.laz", cut("a.laz", 0.05), "ends before the table of its compressed chunks"),
    ("chunks.laz", with_endless_chunk_table, "table of its compressed chunks is damaged"),
    ("scale.las", changed("a.las", struct.pack("<d", 0.001), struct.pack("<d", np.nan)), "scales or offsets"),
    ("flat.las", changed("a.las", struct.pack("<d", 0.001), struct.pack("<d", 0)), "scales or offsets"),
    ("records.las", with_records(2**32 - 1), "promises 4294967295 records for which it has no room"),
    ("records.laz", with_records(70_000), "promises 70000 records for which it has no room"),
    ("last.las", with_records(2**32 - 1, 243, point_format=7), "promises 4294967295 records for which it has no room"),
    ("whole.csv", lambda file: file.write_text("6,370,2,698,0,410\n7,100,3,200,0,11\n"), "half as many with decimal"),
    ("less.ply", changed("a.ply", b"vertex 500", b"vertex -5"), "header line `element vertex -5` is not PLY"),
    ("more.ply", changed("a.ply", b"vertex 500", b"vertex 500000000000000"), "ends after 500 of 500000000000000"),
    ("twice.ply", changed("a.ply", b"double y", b"double x"), "header is inconsistent"),
    ("less.pcd", changed("a.pcd", b"POINTS 501", b"POINTS -1"), "PCD header is incomplete or inconsistent"),
    ("more.pcd", changed("a.pcd", b"POINTS 501", b"POINTS 501000000000000"), "ends after 501 of 501000000000000"),
    ("twice.pcd", changed("a.pcd", b"FIELDS x y", b"FIELDS x x"), "header is inconsistent"),
    ("size.pcd", changed("a.pcd", b"SIZE 8 8", b"SIZE 8 3"), "PCD header is incomplete or inconsistent"),
    ("zip.pcd", changed("a.pcd", b"DATA binary", b"DATA zip"), 'says "DATA zip"'),
    ("cut2.pcd", changed("a.pcd", b"DATA binary", b"DATA binary_compressed"), "ends before its compressed points do"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "write", "message"), REFUSED, ids=[entry[0] for entry in REFUSED])
def test_a_file_that_cannot_be_used_gets_a_sentence(tmp_path, name, write, message):
    write(tmp_path / name)
    with pytest.raises(InputError, match=message) as refusal:
        read_cloud(tmp_path / name)
    assert name in str(refusal.value)


def test_progress_reaches_its_end(tmp_path):
    write_las(tmp_path / "a.laz")
    told = []
    read_cloud(tmp_path / "a.laz", lambda *state: told.append(state))
    assert told == [("cloud", 500, 500)]


def test_a_ray_picks_the_first_surface(building):
    eye = ORIGIN + [0.0, -40.0, 60.0]
    aim = ORIGIN + [1.0, 1.0, ROOF_M]
    place = pick(building, eye, aim - eye, radius_m=0.15)
    np.testing.assert_allclose(place, aim, atol=0.35)
    assert place[2] - ORIGIN[2] == pytest.approx(ROOF_M, abs=0.02)
    assert pick(building, eye, eye - aim) is None


def test_thinning_is_even_repeatable_and_keeps_columns_together():
    whole = site(60_000)
    coloured = Cloud(whole.points_m, whole.origin_m, intensity=whole.points_m[:, 2].astype(np.float32))
    few = thin(coloured, 5000)
    assert 2500 < len(few) <= 5000
    np.testing.assert_array_equal(few.points_m, thin(coloured, 5000).points_m)
    np.testing.assert_array_equal(few.intensity, few.points_m[:, 2].astype(np.float32))
    assert thin(few, 5000) is few


def test_a_stray_echo_far_away_leaves_room_for_the_site():
    whole = site(60_000)
    with_echo = Cloud(np.vstack((whole.points_m, [[30_000.0, 0.0, 0.0]])), whole.origin_m)
    assert 2500 < len(thin(with_echo, 5000)) <= 5000


def test_a_cloud_cannot_be_written_to(building):
    with pytest.raises(ValueError, match="read-only"):
        building.points_m[0, 0] = 1.0
