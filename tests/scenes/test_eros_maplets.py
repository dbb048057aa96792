"""A real picture of Eros, its pointing displaced: maplets of the shape model lead back to one answer."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from catalogs.bodies import BodyModels
from catalogs.images import read_image
from catalogs.shapes import read_solid
from catalogs.sidecar import state_from_sidecar
from pipeline.frame import Frame, FrameOptions, make_frame
from pipeline.geometry.cutting import cut_maplet, spread_landmarks
from pipeline.geometry.maplet import index_of
from pipeline.geometry.pointing import corrected_attitude, move_pivot, offset_between
from pipeline.geometry.rays import tree_of_shape
from pipeline.records import FloatArray, State
from pipeline.techniques.base import TechniqueResult
from pipeline.techniques.surface_features import MapletSource, SurfaceFeatureOptions, surface_feature_nav
from tests.scenes.data import DATA, needs_data

pytestmark = needs_data
FOLDER = DATA / "eros_near"
SIZE, SCALE_KM, COUNT = 49, 0.06, 500


@lru_cache
def scene() -> tuple[State, Frame, MapletSource]:
    solid = read_solid((DATA / "shapes" / "eros.obj").read_bytes(), "eros.obj")
    raw = read_image((FOLDER / "m0126865998f4_2p_iof.fit").read_bytes(), "eros.fit", {})
    models = BodyModels({}, lambda path: solid.mesh)
    sidecar = (FOLDER / "m0126865998f4_2p_iof.geometry.json").read_bytes()
    state = state_from_sidecar(sidecar, "eros", None, {}, raw.pixels.shape, models)
    settings = state.settings.model_copy(update={"fit_camera_rotation": True, "max_rotation_deg": 1.0})
    state = replace(state, settings=settings)
    tree = tree_of_shape(solid)
    corners = solid.mesh.vertices_km[solid.mesh.facets]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    points, facets = spread_landmarks(solid.mesh, COUNT)
    maplets = [
        cut_maplet(tree, (point, normals[facet]), SIZE // 2, SCALE_KM, f"L{k}", 0.05)
        for k, (point, facet) in enumerate(zip(points, facets, strict=True))
    ]
    source = MapletSource("EROS", index_of(maplets), maplets.__getitem__, (tree, solid.diameter_km))
    return state, make_frame(raw.pixels, None, state, FrameOptions()), source


def navigated(displacement: FloatArray, twist_rad: float) -> tuple[FloatArray, TechniqueResult, int]:
    """Attitude that the landmarks give from a displaced one."""
    state, frame, source = scene()
    camera = state.camera_model
    before = corrected_attitude(camera, state.attitude.camera_from_j2000, displacement, twist_rad)
    moved = replace(state, attitude=replace(state.attitude, camera_from_j2000=before))
    fix = surface_feature_nav(moved.bodies[0], source, frame, moved, SurfaceFeatureOptions(state_rounds=0))
    answer, table = fix.answer, fix.table
    assert isinstance(answer, TechniqueResult)
    assert table is not None
    assert fix.state is None
    offset, _ = move_pivot(answer.offset_vu, answer.rotation_rad, answer.pivot_vu, camera.centre_vu)
    return corrected_attitude(camera, before, offset, answer.rotation_rad), answer, int(table.used.sum())


@lru_cache
def undisplaced() -> FloatArray:
    return navigated(np.zeros(2), 0.0)[0]


@pytest.mark.parametrize(
    ("displacement", "twist_deg"),
    [((15.0, 15.0), 0.5), ((-15.0, 15.0), -0.5), ((15.0, -15.0), 0.5), ((-15.0, -15.0), -0.5), ((7.0, -11.0), 0.2)],
)
def test_every_displacement_leads_back(displacement: tuple[float, float], twist_deg: float) -> None:
    attitude, answer, used = navigated(np.array(displacement), float(np.radians(twist_deg)))
    offset, twist = offset_between(scene()[0].camera_model, undisplaced(), attitude)
    assert np.abs(offset).max() < 0.7
    assert abs(np.degrees(twist)) < 0.2
    assert used >= 10
    assert answer.confidence > 0.999
    assert not answer.at_edge
