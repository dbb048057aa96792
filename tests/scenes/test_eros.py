"""A real image of Eros by its mesh: where pieces of it lie, where techniques put it, and what the border hides."""

from functools import cache

import cv2
import numpy as np
import pytest

from catalogs.bodies import BodyModels
from catalogs.images import read_image
from catalogs.shapes import read_shape
from catalogs.sidecar import state_from_sidecar
from pipeline.imaging.render import Window
from pipeline.navigate import Navigation, NavigationOptions, navigate
from pipeline.predict.bodies import BodyPredictionOptions, predict_bodies
from pipeline.records import FloatArray, Image, StarTable, State
from tests.scenes.data import DATA, needs_data

FOLDER = DATA / "eros_near"
# Half-size of a patch, and how far it is looked for.
HALF, REACH = (14, 24), 12


@cache
def _image() -> tuple[Image, State]:
    models = BodyModels({}, lambda path: read_shape((FOLDER / path).read_bytes(), path))
    sidecar = (FOLDER / "m0126865998f4_2p_iof.geometry.json").read_bytes()
    state = state_from_sidecar(sidecar, "eros", None, {}, (), models)
    name = "m0126865998f4_2p_iof.fit"
    return read_image((FOLDER / name).read_bytes(), name).pixels.astype(np.float32), state


@cache
def _rendered() -> Image:
    """A-priori prediction in a frame that is wider by the reach on each side."""
    pixels, state = _image()
    scene = predict_bodies(state, 1.2, BodyPredictionOptions())
    return scene.render(scene.views, Window(0, 0, *pixels.shape).grown(REACH, REACH)).image


def _ncc(a: Image, b: Image) -> float:
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


def _patch_shifts() -> FloatArray:
    """(n, 2) shifts of pieces of the prediction, each found alone."""
    pixels, _ = _image()
    wide = _rendered()
    shifts = []
    for v in range(HALF[0] + REACH, pixels.shape[0] - HALF[0] - REACH, HALF[0]):
        for u in range(HALF[1] + REACH, pixels.shape[1] - HALF[1] - REACH, HALF[1]):
            top, left = v - HALF[0], u - HALF[1]
            piece = wide[top + REACH : top + REACH + 29, left + REACH : left + REACH + 49]
            if piece.std() < 0.02 or (piece > 0.02).mean() < 0.35:
                continue
            around = pixels[top - REACH : top + 29 + REACH, left - REACH : left + 49 + REACH]
            scores = cv2.matchTemplate(around, np.ascontiguousarray(piece), cv2.TM_CCOEFF_NORMED)
            if scores.max() > 0.85:
                shifts.append(np.array(np.unravel_index(int(scores.argmax()), scores.shape)) - REACH)
    return np.array(shifts, float)


@cache
def _navigated() -> Navigation:
    pixels, state = _image()
    return navigate(pixels, None, state, StarTable.empty(), NavigationOptions())


@needs_data
def test_the_prior_seems_right_only_to_a_correlation_that_loses_light_at_the_border() -> None:
    pixels, _ = _image()
    wide = _rendered()
    rows, cols = pixels.shape
    steps = [(dv, du) for dv in range(-8, 9) for du in range(-8, 9)]
    inner = np.s_[REACH:-REACH, REACH:-REACH]
    # The brightest part of Eros is cut by the frame: a rendering that ends there is moved away from it at a loss.
    cut = max(steps, key=lambda s: _ncc(pixels, np.roll(wide[inner], s, (0, 1))))
    assert cut == (0, 0)
    whole = max(
        steps, key=lambda s: _ncc(pixels, wide[REACH - s[0] : REACH - s[0] + rows, REACH - s[1] : REACH - s[1] + cols])
    )
    assert whole[0] in (0, 1)
    assert whole[1] in (-5, -4, -3)


@needs_data
def test_pieces_of_the_face_lie_apart_from_the_prior() -> None:
    shifts = _patch_shifts()
    assert len(shifts) > 80
    assert (np.abs(np.median(shifts, axis=0) - [0.3, -3.5]) <= 0.8).all()
    assert (np.percentile(shifts[:, 1], 90)) < -1.0


@needs_data
@pytest.mark.parametrize("technique", ["BodyDiscCorrelateNav", "BodyTerminatorNav"])
def test_techniques_agree_with_pieces_of_the_face(technique: str) -> None:
    (result,) = (r for r in _navigated().results if r.technique == technique)
    assert not result.spurious
    assert not result.at_edge
    sigma = np.sqrt(np.diag(np.linalg.inv(result.information[:2, :2])))
    # Pieces differ among themselves by 0.4 px along v and 0.9 px along u: scale and shape are not fitted.
    assert (np.abs(result.offset_vu - np.median(_patch_shifts(), axis=0)) < 2.0 * np.hypot(sigma, [0.4, 0.9])).all()
