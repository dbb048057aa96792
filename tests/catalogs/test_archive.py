"""Archives: their descriptions, and the lists of their images, on several file systems."""

import os
import zipfile
from collections.abc import Iterator
from pathlib import Path

import fsspec
import pytest

from catalogs.archive import ImageRef, file_stamp, open_archive, read_bytes
from catalogs.listing import list_images
from pipeline.errors import ConfigurationError
from workflows.config import load_configuration

BLOCKS = load_configuration().instruments
FILES = ("frames/a.fits", "frames/deep/b.fits", "frames/deep/er/c.fits", "frames/a[1].fits", "top.fits", "notes.txt")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    root = tmp_path / "archive"
    for name in FILES:
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(name.encode())
    return root


def listed(url: Path | str, images: object, **keys: object) -> list[ImageRef]:
    return list_images(open_archive(str(url), {"images": images, **keys}), BLOCKS)


def paths(url: Path | str, images: object) -> list[str]:
    return sorted(ref.path for ref in listed(url, images))


def refusal(url: Path | str, overrides: dict[str, object]) -> str:
    with pytest.raises(ConfigurationError) as error:
        list_images(open_archive(str(url), overrides), BLOCKS)
    return str(error.value)


SELECTIONS = [
    ("*.fits", ["top.fits"]),
    ("./*.fits", ["top.fits"]),
    ("frames/*.fits", ["frames/a.fits", "frames/a[1].fits"]),
    ("frames/**/*.fits", ["frames/a.fits", "frames/a[1].fits", "frames/deep/b.fits", "frames/deep/er/c.fits"]),
    ("**/*.fits", ["frames/a.fits", "frames/a[1].fits", "frames/deep/b.fits", "frames/deep/er/c.fits", "top.fits"]),
    ("**/[bc].fits", ["frames/deep/b.fits", "frames/deep/er/c.fits"]),
    ("frames/*/?.fits", ["frames/deep/b.fits"]),
    ("frames/a[1].fits", ["frames/a[1].fits"]),
    (["top.fits", "frames/a.fits", "frames/../top.fits"], ["frames/a.fits", "top.fits"]),
    (["top.fits", "frames/deep/*.fits"], ["frames/deep/b.fits", "top.fits"]),
    (["top.fits", "nothing*.fits"], ["top.fits"]),
]


@pytest.mark.parametrize(("images", "expected"), SELECTIONS)
def test_selection(folder: Path, images: object, expected: list[str]) -> None:
    assert paths(folder, images) == expected


@pytest.fixture
def urls(folder: Path) -> Iterator[list[str]]:
    """The same archive as a folder, a file URL, in memory, at the root of a memory, and in a zip file."""
    packed = folder.parent / "archive.zip"
    memory = fsspec.filesystem("memory")
    with zipfile.ZipFile(packed, "w") as archive:
        for name in FILES:
            archive.write(folder / name, name)
            memory.pipe(f"/held/{name}", name.encode())
    yield [
        str(folder),
        f"{folder}/",
        f"file://{folder}",
        "memory://held",
        f"zip://::{packed}",
        f"zip://::file://{packed}",
    ]
    memory.rm("/held", recursive=True)


@pytest.mark.parametrize(("images", "expected"), SELECTIONS)
def test_selection_by_url(urls: list[str], images: object, expected: list[str]) -> None:
    for url in urls:
        assert paths(url, images) == expected, url


def test_bytes_and_stamps_by_url(urls: list[str]) -> None:
    for url in urls:
        assert read_bytes(url, "frames/deep/b.fits") == b"frames/deep/b.fits"
        stamp = file_stamp(url, "frames/deep/b.fits")
        assert stamp is not None
        assert stamp[0] == len(b"frames/deep/b.fits")
        assert file_stamp(url, "frames/none.fits") is None
        assert file_stamp(url, "top.fits/none.fits") is None
        with pytest.raises(FileNotFoundError):
            read_bytes(url, "frames/none.fits")


def test_file_of_its_own_url(folder: Path) -> None:
    assert read_bytes("memory://elsewhere", f"file://{folder}/top.fits") == b"top.fits"


def test_stamp_of_a_link_is_that_of_its_file(tmp_path: Path) -> None:
    (tmp_path / "real").write_bytes(b"1")
    (tmp_path / "link").symlink_to("real")
    before = file_stamp(str(tmp_path), "link")
    os.utime(tmp_path / "real", (1, 1))
    assert file_stamp(str(tmp_path), "link") != before


def test_linked_folders_are_walked(folder: Path) -> None:
    (folder / "other").symlink_to(folder / "frames" / "deep", target_is_directory=True)
    (folder / "other" / "circle").symlink_to(folder, target_is_directory=True)
    assert paths(folder, "other/*.fits") == ["other/b.fits"]
    assert paths(folder, "**/b.fits") == ["frames/deep/b.fits", "other/b.fits"]


def test_missing_files_of_a_list_stay_in_it(folder: Path) -> None:
    refs = listed(folder, ["top.fits", "gone.fits"])
    assert [(ref.image_id, ref.exists) for ref in refs] == [("gone", False), ("top", True)]


def test_ids(folder: Path) -> None:
    product = folder / "frames" / "lor_0034974376_0x633_sci.fits"
    product.write_bytes(b"")
    (folder / "frames" / "a.geometry.json").write_text('{"image_id": "W/1 x"}')
    ids = {ref.path: ref.image_id for ref in listed(folder, "**/*.fits")}
    assert ids["frames/deep/b.fits"] == "frames__deep__b"
    assert ids["frames/a[1].fits"] == "frames__a_1_"
    assert ids["frames/lor_0034974376_0x633_sci.fits"] == "lor_0034974376_0x633_sci"
    assert ids["frames/a.fits"] == "W__1_x"
    by_header = {ref.path: ref.image_id for ref in listed(folder, "**/*.fits", geometry="header")}
    assert by_header["frames/a.fits"] == "frames__a"
    assert [ref.image_id for ref in listed(folder, "**/*.fits")] == sorted(ids.values())


@pytest.mark.parametrize("sidecar", [b"", b"{", b"[]", b"[" * 50_000, b"\xff", b'{"image_id": 5}'])
def test_broken_sidecars_claim_no_id(folder: Path, sidecar: bytes) -> None:
    (folder / "top.geometry.json").write_bytes(sidecar)
    assert [ref.image_id for ref in listed(folder, "*.fits")] == ["top"]


def test_sidecar_that_is_a_folder_claims_no_id(folder: Path) -> None:
    (folder / "top.geometry.json").mkdir()
    assert [ref.image_id for ref in listed(folder, "*.fits")] == ["top"]


@pytest.mark.parametrize("claim", ["top", "TOP", "t\u00f6p", "t o p"])
def test_collisions_are_refused(folder: Path, claim: str) -> None:
    (folder / "frames" / "a.geometry.json").write_text(f'{{"image_id": "{claim}"}}')
    (folder / "frames" / "deep" / "b.geometry.json").write_text(f'{{"image_id": "{claim.upper()}"}}')
    said = refusal(folder, {"images": "**/*.fits"})
    assert "share the image id" in said
    assert ".fits and " in said


def test_ids_too_long_for_a_file_name_are_refused(folder: Path) -> None:
    (folder / "top.geometry.json").write_text(f'{{"image_id": "{"x" * 201}"}}')
    assert "longer than 200 bytes" in refusal(folder, {"images": "*.fits"})


@pytest.mark.parametrize("images", ["nothing*.fits", "*.FITS", ["x*.fits", "y/*.fits"]])
def test_no_match_is_refused(folder: Path, images: object) -> None:
    assert "no file matches" in refusal(folder, {"images": images})


@pytest.mark.parametrize(
    "images", ["/etc/passwd", "../x.fits", "..", ".", "frames/../../x.fits", "http://a/b.fits", "a\0b"]
)
def test_paths_outside_the_archive_are_refused(folder: Path, images: str) -> None:
    assert "no path inside the archive" in refusal(folder, {"images": [images]})


DESCRIPTIONS = [
    ("", "images"),
    ("- a\n- b\n", "keys and values"),
    ("just text", "keys and values"),
    ("5", "keys and values"),
    ("images: [", "not YAML"),
    ("images: '*.fits'\nimages2: x", "images2"),
    ("images: 5", "images"),
    ("images: []", "images"),
    ("images: ''", "images"),
    ("images: [1, 2]", "images"),
    ("images: {a: b}", "images"),
    ("images: '*.fits'\ngeometry: spice2", "geometry"),
    ("images: '*.fits'\ngeometry: 5", "geometry"),
    ("images: '*.fits'\n1: x", "1"),
    ("images: '*.fits'\nname: [a]", "name"),
    ("images: '*.fits'\nsettings: 5", "settings"),
    ("images: '*.fits'\nstars: 5", "stars"),
    ("images: '*.fits'\nstars: [{path: s.csv, place: somewhere}]", "place"),
    ("images: '*.fits'\nstars: [{place: mean}]", "path"),
    ("images: '*.fits'\nstars: [{path: s.csv, colour: red}]", "colour"),
    ("\t\x00", "not YAML"),
    ("name: 2001-99-99", "not YAML"),
    ("\udcff", "not YAML"),
    ("[" * 3000, "not YAML"),
]


@pytest.mark.parametrize(("text", "named"), DESCRIPTIONS)
def test_spoiled_descriptions_are_refused(folder: Path, text: str, named: str) -> None:
    (folder / "archive.yaml").write_bytes(text.encode("utf-8", "surrogateescape"))
    said = refusal(folder, {})
    assert named in said
    assert "archive.yaml" in said


def test_overrides_are_named_by_their_flag(folder: Path) -> None:
    (folder / "archive.yaml").write_text("images: '*.fits'")
    assert "--set archive.geometry" in refusal(folder, {"geometry": "moon"})
    assert "--set archive.colour" in refusal(folder, {"colour": "red"})


def test_places_that_are_no_archive(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    for url in (tmp_path / "none", tmp_path / "file", f"zip://::{tmp_path}/file", f"zip://::{tmp_path}/none.zip",
                "nonsense://x", "memory://none", tmp_path / "none" / "archive.yaml"):  # fmt: skip
        said = refusal(url, {"images": "*"})
        assert str(url).split("/archive.yaml")[0] in said
    assert "has no archive.yaml" in refusal(tmp_path, {})


def test_description_may_have_another_name(folder: Path) -> None:
    (folder / "mine.yaml").write_text("images: top.fits")
    assert [ref.path for ref in list_images(open_archive(str(folder / "mine.yaml"), {}), BLOCKS)] == ["top.fits"]
