"""Lists of images: labels and their files as one, index tables, and what is selected of them."""

from collections.abc import Sequence
from pathlib import Path

import fsspec
import pytest

from catalogs.archive import ImageRef, open_archive
from catalogs.index_tables import read_collection, read_pds3_index
from catalogs.listing import list_images
from pipeline.errors import ConfigurationError
from tests.catalogs.planetary import pds3_label, pds4_label
from workflows.config import load_configuration

BLOCKS = load_configuration().instruments


def listed(url: Path | str, images: object, **select: object) -> list[ImageRef]:
    return list_images(open_archive(str(url), {"images": images, "select": select}), BLOCKS)


def ids(url: Path | str, images: object, **select: object) -> list[str]:
    return [ref.image_id for ref in listed(url, images, **select)]


def refusal(url: Path | str, images: object, **select: object) -> str:
    with pytest.raises(ConfigurationError) as error:
        listed(url, images, **select)
    assert "\n" not in str(error.value)
    return str(error.value)


def put(root: Path, name: str, data: bytes = b"x") -> None:
    path = root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)


@pytest.mark.parametrize("pattern", ["data/*.IMG", "data/*.LBL", "data/*", ["data/*.LBL", "data/*.IMG"], "**/N*"])
def test_an_image_and_its_label_are_one(tmp_path: Path, pattern: object) -> None:
    for number in ("1473172656_1", "1473172657_1"):
        put(tmp_path, f"data/N{number}.IMG")
        put(tmp_path, f"data/N{number}.LBL", pds3_label(f'("N{number}.IMG",1)', "UNSIGNED_INTEGER", 8, (4, 4)))
    assert listed(tmp_path, pattern) == [
        ImageRef(f"N{n}_1", f"data/N{n}_1.IMG", True, (f"data/N{n}_1.LBL",)) for n in (1473172656, 1473172657)
    ]


def test_labels_name_files_of_other_stems_and_cases(tmp_path: Path) -> None:
    put(tmp_path, "a.lbl", pds3_label('("PIXELS.DAT",1)', "UNSIGNED_INTEGER", 8, (4, 4)))
    put(tmp_path, "pixels.dat")
    put(tmp_path, "b.xml", pds4_label("gone.img", "UnsignedByte", (4, 4)))
    put(tmp_path, "c.lbl", b"this is no label")
    put(tmp_path, "d.fit")
    put(tmp_path, "d.LBL", b"unread")
    assert listed(tmp_path, ["*.lbl", "*.xml", "d.fit"]) == [
        ImageRef("c", "c.lbl"), ImageRef("d", "d.fit", True, ("d.LBL",)),
        ImageRef("gone", "gone.img", False, ("b.xml",)), ImageRef("pixels", "pixels.dat", True, ("a.lbl",)),
    ]  # fmt: skip


COLUMNS = (
    ("FILE_SPECIFICATION_NAME", "CHARACTER", 34), ("VOLUME_ID", "CHARACTER", 10), ("PRODUCT_ID", "CHARACTER", 18),
    ("INSTRUMENT_ID", "CHARACTER", 6), ("START_TIME", "TIME", 21), ("TARGET_NAME", "CHARACTER", 10),
    ("FILTER_NAME", "CHARACTER", 7), ("IMAGE_NUMBER", "CHARACTER", 10), ("EXPOSURE_DURATION", "ASCII_REAL", 8),
    ("TARGET_SIZE_PX", "ASCII_REAL", 7),
)  # fmt: skip
ROWS = (
    ("data/a/N1473172656_1.IMG", "COISS_2001", "1_N1473172656.118", "ISSNA", "2004-250T14:12:40.732", "SATURN",
     ("CL1", "CB2"), "1473172656", 2600.0, 2000.5),
    ("data/a/N1473172700_1.IMG", "COISS_2001", "1_N1473172700.118", "ISSNA", "2004-250T14:13:20.000", "RHEA",
     ("CL1", "CL2"), "1473172700", 100.0, 55.0),
    ("data/b/W1473173000_2.IMG", "COISS_2002", "1_W1473173000.118", "ISSWA", "2004-251T00:00:00.000", "S_RINGS",
     ("CL1", "RED"), "1473173000", 38.0, 4000.0),
    ("data/b/W1473179999_1.IMG", "COISS_2002", "1_W1473179999.118", "ISSWA", "UNK", "SKY",
     ("CL1", "CL2"), "1473179999", 38.0, 0.0),
)  # fmt: skip
ALL = ["N1473172656_1", "N1473172700_1", "W1473173000_2", "W1473179999_1"]


def index_table(rows: Sequence[Sequence[object]], leave: Sequence[str] = ()) -> tuple[bytes, bytes]:
    """Fixed columns as PDS3 archives have them, and their label."""
    columns = [column for column in COLUMNS if column[0] not in leave]
    places, position, lines = [], 1, []
    for name, kind, width in columns:
        quoted = kind in ("CHARACTER", "TIME")
        items = "ITEMS = 2  ITEM_BYTES = 7  ITEM_OFFSET = 10" if name == "FILTER_NAME" else ""
        places.append((position + quoted, width if name != "FILTER_NAME" else 17, name, kind, items))
        position += (width + 2 * quoted + 1) if name != "FILTER_NAME" else 20
    for row in rows:
        cells = []
        for (name, kind, width), value in zip(COLUMNS, row, strict=True):
            if name in leave:
                continue
            values = value if isinstance(value, tuple) else (value,)
            cells += [f'"{v!s:<{width}}"' if kind in ("CHARACTER", "TIME") else f"{v!s:>{width}}" for v in values]
        lines.append(",".join(cells) + "\r\n")
    objects = "".join(
        f"OBJECT = COLUMN  NAME = {name}  DATA_TYPE = {kind}  START_BYTE = {start}  BYTES = {width}  {items}\r\n"
        f'DESCRIPTION = "what it is,\r\n in words = (more)"  END_OBJECT = COLUMN\r\n'
        for start, width, name, kind, items in places
    )
    label = f"""PDS_VERSION_ID = PDS3\r\nRECORD_TYPE = FIXED_LENGTH\r\n^IMAGE_INDEX_TABLE = "INDEX.TAB"
OBJECT = IMAGE_INDEX_TABLE  INTERCHANGE_FORMAT = ASCII  ROWS = {len(rows)}  ROW_BYTES = {len(lines[0])}
{objects}END_OBJECT = IMAGE_INDEX_TABLE\r\nEND\r\n"""
    return "".join(lines).encode(), label.encode()


@pytest.fixture
def volumes(tmp_path: Path) -> Path:
    """An archive with an index of four images, of which one is not there."""
    table, label = index_table(ROWS)
    put(tmp_path, "index/INDEX.TAB", table)
    put(tmp_path, "index/index.lbl", label)
    for row in ROWS[:3]:
        put(tmp_path, str(row[0]))
        put(tmp_path, str(row[0]).replace(".IMG", ".LBL"))
    return tmp_path


INDEX = {"index": "index/INDEX.TAB"}


def test_cells_of_an_index() -> None:
    rows = read_pds3_index(*index_table(ROWS), "INDEX.TAB")
    assert rows[0] == {
        "FILE_SPECIFICATION_NAME": "data/a/N1473172656_1.IMG", "VOLUME_ID": "COISS_2001",
        "PRODUCT_ID": "1_N1473172656.118", "INSTRUMENT_ID": "ISSNA", "START_TIME": "2004-250T14:12:40.732",
        "TARGET_NAME": "SATURN", "FILTER_NAME": "CL1,CB2", "IMAGE_NUMBER": "1473172656", "EXPOSURE_DURATION": 2600.0,
        "TARGET_SIZE_PX": 2000.5,
    }  # fmt: skip
    assert len(rows) == len(ROWS)


def test_images_of_an_index(volumes: Path) -> None:
    refs = listed(volumes, INDEX)
    assert [ref.image_id for ref in refs] == ALL
    assert [ref.exists for ref in refs] == [True, True, True, False]
    assert refs[0] == ImageRef(ALL[0], "data/a/N1473172656_1.IMG", True, ("data/a/N1473172656_1.LBL",))
    assert refs[3].path == "data/b/W1473179999_1.IMG"


def test_index_of_volumes_below_the_root(tmp_path: Path) -> None:
    """A cumulative index beside the volumes, one inside its volume, and files that differ in case."""
    table, label = index_table(ROWS)
    for row in ROWS[:3]:
        put(tmp_path, f"{row[1]}/{str(row[0]).lower()}")
    for folder in ("metadata", "COISS_2001/index"):
        put(tmp_path, f"{folder}/INDEX.TAB", table)
        put(tmp_path, f"{folder}/INDEX.LBL", label)
        refs = listed(tmp_path, {"index": f"{folder}/INDEX.TAB"})
        assert [ref.path for ref in refs if ref.exists] == [f"{r[1]}/{str(r[0]).lower()}" for r in ROWS[:3]], folder


def test_index_in_memory() -> None:
    table, label = index_table(ROWS)
    memory = fsspec.filesystem("memory")
    memory.pipe({"/volumes/index/INDEX.TAB": table, "/volumes/index/INDEX.LBL": label, f"/volumes/{ROWS[0][0]}": b"x"})
    try:
        refs = listed("memory://volumes", INDEX, target="saturn")
        assert [(ref.image_id, ref.exists) for ref in refs] == [(ALL[0], True)]
    finally:
        memory.rm("/volumes", recursive=True)


def test_products_without_a_known_pattern_have_the_indexes_ids(tmp_path: Path) -> None:
    rows = [("x/one.dat", "V", "PRODUCT.IMG", *ROWS[0][3:]), ("x/two.dat", "V", "OTHER_1.2", *ROWS[1][3:])]
    table, label = index_table(rows)
    put(tmp_path, "index/INDEX.TAB", table)
    put(tmp_path, "index/INDEX.LBL", label)
    assert ids(tmp_path, INDEX) == ["OTHER_1.2", "PRODUCT"]
    table, label = index_table([rows[0], (rows[1][0], "V", "product", *ROWS[1][3:])])
    put(tmp_path, "index/INDEX.TAB", table)
    assert "share the image id" in refusal(tmp_path, INDEX)


SELECTIONS: list[tuple[dict[str, object], list[int]]] = [
    ({}, [0, 1, 2, 3]), ({"target": "SATURN"}, [0]), ({"target": ["rhea", "S RINGS"]}, [1, 2]),
    ({"volume": "COISS_2002"}, [2, 3]), ({"start": "2004-250T14:13:00"}, [1, 2]),
    ({"start": "2004-09-06", "stop": "2004-09-06T14:13:20"}, [0, 1]), ({"stop": "2004-250T14:13:00"}, [0]),
    ({"filter": "CB2"}, [0]), ({"filter": ["RED", "CL1+CL2"]}, [1, 2, 3]), ({"camera": "coiss_nac"}, [0, 1]),
    ({"camera": "WAC"}, [2, 3]), ({"camera": ["ISSNA", "WAC"]}, [0, 1, 2, 3]),
    ({"image_numbers": [1473172656, 1473172700]}, [0, 1]), ({"image_numbers": 1473173000}, [2]),
    ({"image_numbers": [1473172656, 1473172701, 1473179999]}, [0, 3]), ({"target_size_px": [50, 2500]}, [0, 1]),
    ({"camera": "NAC", "target_size_px": [50, 100]}, [1]),
]  # fmt: skip


@pytest.mark.parametrize(("select", "expected"), SELECTIONS)
def test_selection(volumes: Path, select: dict[str, object], expected: list[int]) -> None:
    assert ids(volumes, INDEX, **select) == [ALL[number] for number in expected]


def test_selection_by_paths_and_product_ids(volumes: Path) -> None:
    assert ids(volumes, "data/**/*.IMG", volume="a") == ALL[:2]
    assert ids(volumes, "data/**/*.IMG", image_numbers=[1473172700, 1473173000]) == ALL[1:3]
    assert "select leaves none of 3 images" in refusal(volumes, "data/**/*.IMG", volume="c")


@pytest.mark.parametrize("key", ["start", "stop", "target", "filter", "camera", "target_size_px"])
def test_what_cannot_be_met_is_said(volumes: Path, key: str) -> None:
    value: object = {"start": "2004-01-01", "stop": "2004-01-01", "target_size_px": [1, 2]}.get(key, "X")
    assert f"select.{key} needs an index table" in refusal(volumes, "data/**/*.IMG", **{key: value})
    lost = {"filter": "FILTER_NAME", "target": "TARGET_NAME", "camera": "INSTRUMENT_ID", "start": "START_TIME",
            "stop": "START_TIME", "target_size_px": "TARGET_SIZE_PX"}[key]  # fmt: skip
    table, label = index_table(ROWS, leave=(lost,))
    put(volumes, "index/INDEX.TAB", table)
    put(volumes, "index/index.lbl", label)
    assert f"select.{key} cannot be met: there is no column" in refusal(volumes, INDEX, **{key: value})


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("colour", "red"), ("start", "yesterday"), ("target", []), ("target", 5.5), ("image_numbers", ["x"]),
        ("image_numbers", []), ("target_size_px", [5, 1]), ("target_size_px", 5), ("target_size_px", [1, 2, 3]),
    ],
)  # fmt: skip
def test_selections_that_cannot_be_meant(volumes: Path, key: str, value: object) -> None:
    assert f"select.{key}" in refusal(volumes, INDEX, **{key: value})


def test_selection_on_the_command_line_joins_that_of_the_file(volumes: Path) -> None:
    (volumes / "archive.yaml").write_text(
        "images: {index: index/INDEX.TAB}\nselect: {camera: NAC, start: 2004-09-06, target: RHEA}\n"
    )
    for target, expected in (("SATURN", ALL[:1]), ("RHEA", ALL[1:2])):
        archive = open_archive(str(volumes), {"select": {"target": target}})
        assert [ref.image_id for ref in list_images(archive, BLOCKS)] == expected


SPOILED = [
    ("ROWS = 4", "ROWS = 5", "has 4 rows of 5"), ("START_BYTE = 2 ", "START_BYTE = x ", "has no place in the row"),
    ("NAME = FILE_SPECIFICATION_NAME", "NAME = THING", "names the files"),
    ("START_BYTE = 2 ", "START_BYTE = 900 ", "row 1 ends before"), ("= COLUMN", "= CORNER", "describes no columns"),
    ("END_OBJECT = IMAGE_INDEX_TABLE", "", "is not closed"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "problem"), SPOILED)
def test_spoiled_indexes_are_refused(volumes: Path, old: str, new: str, problem: str) -> None:
    label = index_table(ROWS)[1]
    assert old in label.decode()
    put(volumes, "index/index.lbl", label.decode().replace(old, new).encode())
    said = refusal(volumes, INDEX)
    assert problem in said
    assert "INDEX.TAB" in said


def test_indexes_that_are_not_there(volumes: Path) -> None:
    assert "is not there" in refusal(volumes, {"index": "index/OTHER.TAB"})
    assert "no path inside" in refusal(volumes, {"index": "../INDEX.TAB"})
    (volumes / "index" / "index.lbl").unlink()
    assert "has no label" in refusal(volumes, INDEX)
    assert "images" in refusal(volumes, {"index": ""})
    assert "images" in refusal(volumes, {"table": "index/INDEX.TAB"})


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    """A PDS4 bundle of two images, one of which the collection's inventory also lists without having it."""
    for product, target, start in (("one", "Saturn", "2004-09-06T14:12:40Z"), ("two", "Rhea", "2004-09-07T00:00:00Z")):
        more = f"""<Time_Coordinates><start_date_time>{start}</start_date_time></Time_Coordinates>
          <Target_Identification><name>{target}</name></Target_Identification>"""
        put(
            tmp_path,
            f"data/{product}.xml",
            pds4_label(f"{product}.img", "UnsignedByte", (4, 4), product=product, more=more),
        )
        put(tmp_path, f"data/{product}.img")
    put(tmp_path, "data/other.xml", b"<?xml version='1.0'?><Product_Document/>")
    put(tmp_path, "data/broken.xml", b"<?xml version='1.0'?><broken")
    lines = [f"P,urn:nasa:pds:bundle:data:{name}::1.0" for name in ("three", "one", "two")]
    lines.append("S,urn:nasa:pds:elsewhere:data:four::1.0")
    put(tmp_path, "data/collection.csv", "\r\n".join(lines).encode())
    return tmp_path


COLLECTION = {"index": "data/collection.csv"}


def test_members_of_a_collection(bundle: Path) -> None:
    refs = listed(bundle, COLLECTION)
    assert [(ref.image_id, ref.path, ref.exists) for ref in refs] == [
        ("data__one", "data/one.img", True), ("data__two", "data/two.img", True), ("three", "three.xml", False),
    ]  # fmt: skip
    assert refs[0].companions == ("data/one.xml",)
    assert ids(bundle, COLLECTION, target="RHEA") == ["data__two"]
    assert ids(bundle, COLLECTION, stop="2004-09-06T23:00:00") == ["data__one"]
    assert "select.filter cannot be met" in refusal(bundle, COLLECTION, filter="CL1")


@pytest.mark.parametrize("text", [b"a,b\n", b"P\n", b"<?xml", b"P,urn:x:y\nQ,urn:x:z\n"])
def test_other_tables_are_no_collection(text: bytes) -> None:
    with pytest.raises(ConfigurationError, match="no member of a collection"):
        read_collection(text, "c.csv")
