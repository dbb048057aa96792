"""Dawn at Vesta: each given view solved alone with points of the other views, and the poses held back."""

import numpy as np
import pytest

from catalogs.matches import read_cameras, read_matches
from pipeline.pose.records import PoseEstimate
from tests.scenes.data import DATA, needs_data
from workflows.pose import Budget, CovarianceChoice, Views, compare_given, prepare, solve_views

pytestmark = [needs_data, pytest.mark.slow]
FOLDER = DATA / "vesta_rc3b"


@pytest.fixture(scope="module")
def views() -> Views:
    matches = read_matches((FOLDER / "observations.parquet").read_bytes(), "observations")
    return prepare(matches, read_cameras((FOLDER / "cameras.json").read_bytes(), "cameras"))


def test_given_views_solved_alone(views: Views) -> None:
    rows = list(solve_views(views, Budget(CovarianceChoice.MARGINALS), every=True))
    assert len(rows) == 65
    assert all(isinstance(row.answer, PoseEstimate) for row in rows)
    away = compare_given(views, rows)
    assert len(away) == 44
    middle = np.median(away, axis=0)
    # Given poses and tracks disagree by 1.6 km and 0.33 mrad themselves.
    assert middle[0] <= 2.0
    assert middle[1] <= 0.5e-3
    assert np.sqrt((away[:, 2:4] ** 2).mean(axis=0)).max() <= 1.2
