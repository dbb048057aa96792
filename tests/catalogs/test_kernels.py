"""Meta-kernels and kernels: what is loaded in which order, and what is refused in one line."""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
import spiceypy

from catalogs.kernels import check_kernels, load, parse_text_kernel
from pipeline.errors import ConfigurationError
from tests.scenes.kernels import FILES, write_kernels


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("made")
    write_kernels(path / "kernels")
    return path


@pytest.fixture
def archive(made: Path, tmp_path: Path) -> Iterator[Path]:
    shutil.copytree(made, tmp_path / "archive")
    yield tmp_path / "archive"
    spiceypy.kclear()


def check(archive: Path, listed: str | list[str] = "kernels/meta.tm", verify: bool = False) -> list[str]:
    return [kernel.name for kernel in check_kernels(str(archive), listed, archive.parent / "cache", verify)]


def refusal(archive: Path, listed: str | list[str] = "kernels/meta.tm") -> str:
    with pytest.raises(ConfigurationError) as failure:
        check(archive, listed)
    text = str(failure.value)
    assert "\n" not in text
    return text


def meta(archive: Path, content: str) -> None:
    (archive / "kernels" / "meta.tm").write_text(f"KPL/MK\n\\begindata\n{content}\n\\begintext\n")


def test_files_of_a_meta_kernel_lie_beside_it(archive: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert check(archive) == ["meta.tm", *FILES]
    assert spiceypy.ktotal("ALL") == len(FILES)
    # Neither the working directory nor an absolute name makes a difference, nor loading it again.
    monkeypatch.chdir(archive)
    assert check(Path("."), [str(archive / "kernels" / "meta.tm")]) == ["meta.tm", *FILES]
    assert spiceypy.ktotal("ALL") == len(FILES)


def test_a_list_of_kernels_is_as_good(archive: Path) -> None:
    listed = [f"kernels/{name}" for name in FILES]
    assert check(archive, listed) == list(FILES)


def test_long_names_and_symbols(archive: Path) -> None:
    deep = archive / "kernels" / ("d" * 60) / ("e" * 60)
    deep.mkdir(parents=True)
    shutil.move(archive / "kernels" / "naif.tls", deep / "naif.tls")
    pieces = f"'$TOP/{'d' * 60}/+'\n '{'e' * 60}+'\n '/naif.tls'"
    others = " ".join(f"'$T/{name}'" for name in FILES[1:])
    meta(
        archive,
        f"PATH_VALUES = ( '.' '../kernels' )\nPATH_SYMBOLS = ( 'T' 'TOP' )\n"
        f"KERNELS_TO_LOAD = ( {pieces} )\nKERNELS_TO_LOAD += ( {others} )",
    )
    assert check(archive) == ["meta.tm", *FILES]


def test_later_kernels_and_a_meta_kernels_own_data_count(archive: Path) -> None:
    (archive / "kernels" / "late.tpc").write_text("KPL/PCK\n\\begindata\nBODY601_RADII = ( 1 2 3 )\n\\begintext\n")
    files = " ".join(f"'{name}'" for name in (*FILES, "late.tpc"))
    meta(archive, f"KERNELS_TO_LOAD = ( {files} )\nMY_FIGURE = 5.5")
    check(archive)
    assert list(spiceypy.gdpool("BODY601_RADII", 0, 3)) == [1.0, 2.0, 3.0]
    assert spiceypy.gdpool("MY_FIGURE", 0, 1)[0] == 5.5


def test_digests_are_remembered_until_a_file_changes(archive: Path) -> None:
    def digests(verify: bool = False) -> dict[str, str]:
        return {k.name: k.sha256 for k in check_kernels(str(archive), "kernels/meta.tm", archive.parent, verify)}

    first, path = digests(), archive / "kernels" / "bodies.tpc"
    status = path.stat()
    # Same size, same time: only reading tells the difference.
    path.write_text(path.read_text().replace("207.8", "207.9"))
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert digests() == first
    verified = digests(verify=True)
    assert {name for name in first if first[name] != verified[name]} == {"bodies.tpc"}
    assert digests() == verified
    (archive.parent / "kernels.json").write_text("[]")
    assert digests() == verified


def test_missing_and_strange_files(archive: Path) -> None:
    assert "not there" in refusal(archive, "kernels/none.tm")
    assert "cannot be read" in refusal(archive, "kernels")
    (archive / "kernels" / "page.html").write_text("<html>404</html>")
    assert "neither a text nor a binary" in refusal(archive, ["kernels/page.html"])
    meta(archive, "KERNELS_TO_LOAD = ( 'gone.bsp' )")
    assert "gone.bsp is not there" in refusal(archive)
    meta(archive, "KERNELS_TO_LOAD = ( '$WHERE/naif.tls' )")
    assert "$WHERE" in refusal(archive)
    meta(archive, "KERNELS_TO_LOAD = ( 'meta.tm' )")
    assert "does not allow" in refusal(archive)
    meta(archive, "PATH_SYMBOLS = ( 'A' )\nKERNELS_TO_LOAD = ( 'naif.tls' )")
    assert "PATH_VALUES" in refusal(archive)
    assert "LSK" in refusal(archive, [f"kernels/{name}" for name in FILES[1:]])
    assert "local" in refusal(archive, "https://example.org/meta.tm")
    assert "local" in refusal(archive, [])
    assert "longer" in refusal(archive, f"kernels/{'x' * 250}")


@pytest.mark.parametrize("name", ["orbits.bsp", "pointing.bc"])
def test_truncated_binary_kernels(archive: Path, name: str) -> None:
    path = archive / "kernels" / name
    path.write_bytes(path.read_bytes()[:3000])
    assert refusal(archive) == f"kernel {name} is truncated"


@pytest.mark.parametrize(
    "text", ["BODY601_RADII = ( 1 'a", "BODY601_RADII ( 1 2 3 )", "BODY601_RADII = 'a", "BODY601_RADII = ", "= 5", "("]
)
def test_damaged_text_kernels(archive: Path, text: str) -> None:
    (archive / "kernels" / "bodies.tpc").write_text(f"KPL/PCK\n\\begindata\n{text}\n\\begintext\n")
    assert refusal(archive).startswith("kernel bodies.tpc: ")
    meta(archive, f"KERNELS_TO_LOAD = ( 'naif.tls' )\n{text}")
    assert refusal(archive).startswith("kernel meta.tm: ")


def test_nothing_stays_loaded_of_what_was_refused(archive: Path) -> None:
    kernels = check_kernels(str(archive), "kernels/meta.tm", archive.parent)
    (archive / "kernels" / "bodies.tpc").write_text("KPL/PCK\n\\begindata\n= 5\n\\begintext\n")
    with pytest.raises(ConfigurationError):
        load(kernels)
    assert spiceypy.ktotal("ALL") == 0


def test_text_kernels_are_parsed_as_naif_writes_them() -> None:
    text = b"A = 5\n\\begindata\nB = 1.5D0\n C=('it''s' , 'two')\n\\begintext\nD = 9\n\\begindata\nC += 'three'\n"
    assert parse_text_kernel(text, "x") == {"B": ["1.5D0"], "C": ["it's", "two", "three"]}
