"""Star tables as they come, and as they must not come."""

import io

import numpy as np
import pandas as pd
import pytest
from astropy.table import Table

from catalogs.star_sources import TableProblem, hipparcos_stars, read_table

GOOD = pd.DataFrame({"star_id": ["a", "b"], "ra_deg": [10.0, 350.0], "dec_deg": [-5.0, 89.0], "mag": [3.0, 11.5]})


def as_parquet(frame: pd.DataFrame) -> bytes:
    return bytes(frame.to_parquet(index=False))


def as_csv(frame: pd.DataFrame) -> bytes:
    return frame.to_csv(index=False).encode()


def as_fits(frame: pd.DataFrame) -> bytes:
    out = io.BytesIO()
    table = Table({name: frame[name].to_numpy(dtype="U8" if name == "star_id" else float) for name in frame.columns})
    table.write(out, format="fits")
    return out.getvalue()


@pytest.mark.parametrize(("write", "name"), [(as_parquet, "s.parquet"), (as_csv, "s.csv"), (as_fits, "S.FITS")])
def test_formats_agree(write, name: str) -> None:  # type: ignore[no-untyped-def]
    table = read_table(write(GOOD), name, apparent=True)
    assert table.star_id.tolist() == ["a", "b"]
    assert table.ra_deg.tolist() == [10.0, 350.0]
    assert table.dec_deg.tolist() == [-5.0, 89.0]
    assert table.mag.tolist() == [3.0, 11.5]
    assert table.apparent.all()
    assert np.isnan(table.parallax_mas).all()
    assert np.isnan(table.epoch).all()


def test_whole_numbers_and_comments_are_fine() -> None:
    data = b"# from a person\nra_deg,dec_deg,mag,epoch\n1,2,3,2000\n"
    table = read_table(data, "s.csv", apparent=False)
    assert table.star_id.tolist() == ["0"]
    assert table.epoch.tolist() == [2000.0]


def test_empty_table_is_a_table() -> None:
    assert len(read_table(as_parquet(GOOD.iloc[:0]), "s.parquet", apparent=False)) == 0


SPOILED = [
    (as_parquet(GOOD.drop(columns="mag")), "s.parquet", "lacks the column mag"),
    (as_parquet(GOOD.assign(ra_deg=["x", "y"])), "s.parquet", "ra_deg is not numeric"),
    (as_parquet(GOOD.assign(mag=[np.nan, 1.0])), "s.parquet", "row 1 has no finite mag"),
    (as_parquet(GOOD.assign(dec_deg=[0.0, np.inf])), "s.parquet", "row 2 has no finite dec_deg"),
    (as_parquet(GOOD.assign(ra_deg=pd.array([1, None], dtype="Int64"))), "s.parquet", "ra_deg"),
    (as_parquet(GOOD.assign(ra_deg=pd.Series([[1.0], [2.0]], dtype=object))), "s.parquet", "ra_deg is not numeric"),
    (as_csv(GOOD.assign(ra_deg=[361.0, 0.0])), "s.csv", "-360..360"),
    (as_csv(GOOD.assign(dec_deg=[0.0, -91.0])), "s.csv", "row 2 has a declination"),
    (as_csv(GOOD.assign(mag=[99.0, 0.0])), "s.csv", "magnitude beyond 40"),
    (as_csv(GOOD.assign(epoch=[5.0, 2000.0])), "s.csv", "Julian year"),
    (as_csv(GOOD.assign(pm_ra_masyr=[1e300, 0.0], pm_dec_masyr=0.0)), "s.csv", "proper motion"),
    (as_csv(GOOD.assign(parallax_mas=[1e9, 0.0])), "s.csv", "parallax"),
    (b"", "s.csv", "cannot be read"),
    (b"", "s.parquet", "cannot be read"),
    (b"", "s.fits", "cannot be read"),
    (b"PAR1 no table PAR1", "s.parquet", "cannot be read"),
    (as_parquet(GOOD)[:-20], "s.parquet", "cannot be read"),
    (b"a,b\n1,2,3\n4\n", "s.csv", ""),
    (b"\xff\xfe\x00", "s.csv", "cannot be read"),
    (b"SIMPLE  =                    T", "s.fits", "cannot be read"),
    (as_fits(GOOD)[:2880], "s.fits", "cannot be read"),
    (as_csv(GOOD), "s.txt", ".parquet, .csv or .fits"),
    (as_csv(GOOD), "stars", ".parquet, .csv or .fits"),
]


@pytest.mark.parametrize(("data", "name", "said"), SPOILED)
def test_spoiled_tables_are_refused_in_one_line(data: bytes, name: str, said: str) -> None:
    with pytest.raises(TableProblem) as problem:
        read_table(data, name, apparent=False)
    assert said in str(problem.value)
    assert "\n" not in str(problem.value)


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
@pytest.mark.parametrize(("write", "name"), [(as_parquet, "s.parquet"), (as_fits, "s.fits")])
def test_truncated_tables_never_end_in_another_error(write, name: str, share: float) -> None:  # type: ignore[no-untyped-def]
    data = write(pd.concat([GOOD] * 300))
    with pytest.raises(TableProblem):
        read_table(data[: int(share * len(data))], name, apparent=False)


def test_hipparcos_is_whole() -> None:
    stars = hipparcos_stars()
    assert len(stars) == 117_955
    sirius = stars.take(stars.star_id == "HIP 32349")
    assert sirius.ra_deg[0] == pytest.approx(101.2885, abs=1e-3)
    assert sirius.parallax_mas[0] == pytest.approx(379.21, abs=0.01)
    assert (stars.parallax_mas >= 0).all()
