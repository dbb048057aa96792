"""Culling of maplets: each test against brute force, and the figures that the cones and the rays must hold."""

import time

import numpy as np
import pytest

from pipeline.camera import project, unproject
from pipeline.geometry.cutting import frame_about, spread_landmarks
from pipeline.geometry.maplet import MapletIndex, MapletView
from pipeline.geometry.patches import first_patch_hit
from pipeline.geometry.rays import tree_of_shape
from pipeline.geometry.shape import Shape, icq_cells
from pipeline.predict.maplets import (
    CullingOptions,
    MapletReason,
    array_cone,
    cells_per_pixel,
    cone_test,
    cull,
    maplet_jacobian,
    nine_point_test,
    occlusion_test,
)
from pipeline.records import CameraModel, FloatArray
from tests.pipeline.geometry.test_shape import icq_of, mesh_of

ICQ = icq_of(10.0, 24, 0.6)
SHAPE = Shape(mesh_of(ICQ), ICQ)
TREE = tree_of_shape(SHAPE)
# Off-centre axis, mirrored array, barrel, tip, swirl.
CAMERA = CameraModel(
    (300, 400), 50.0, np.array([[40.0, 0.3], [-0.2, -41.0]]), np.array([140.0, 230.0]),
    np.array([-8e-4, 2e-6, 3e-5, -2e-5, 1e-5, 0.0]),
)  # fmt: skip


def index_on(shape: Shape, count: int, half: int = 49, scale_km: float = 0.01) -> MapletIndex:
    points, facets = spread_landmarks(shape.mesh, count)
    corners = shape.mesh.vertices_km[shape.mesh.facets[facets]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    radius = np.full(count, np.sqrt(2.0) * half * scale_km)
    return MapletIndex(
        np.array([f"L{k}" for k in range(count)]), points, np.array([frame_about(n) for n in normals]),
        np.full(count, scale_km), np.full(count, half), radius, np.broadcast_to(np.eye(3) * 1e-4, (count, 3, 3)),
    )  # fmt: skip


def look(position: FloatArray, target: FloatArray, twist: float, camera: CameraModel = CAMERA) -> MapletView:
    """View of a target from a position, turned about the line of sight."""
    z = (target - position) / np.linalg.norm(target - position)
    x = np.cross(z, [0.36, -0.48, 0.8])
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    c, s = np.cos(twist), np.sin(twist)
    return MapletView(camera, np.stack([c * x + s * y, c * y - s * x, z]), position, np.array([0.6, 0.0, 0.8]))


def random_view(rng: np.random.Generator) -> MapletView:
    away = rng.normal(size=3)
    position = away / np.linalg.norm(away) * 10.0 * 10 ** rng.uniform(0.02, 2.0)
    return look(position, rng.normal(size=3) * 8.0, rng.uniform(0, 6.28))


def test_eq_3_3_to_3_5_boresight_is_the_ray_through_the_centre_and_the_cone_holds_the_array() -> None:
    boresight, half = array_cone(CAMERA)
    pixel, _ = project(CAMERA, boresight[None])
    assert pixel[0] == pytest.approx(CAMERA.centre_vu, abs=1e-7)
    rng = np.random.default_rng(1)
    pixels = rng.uniform([-0.5, -0.5], [299.5, 399.5], (20_000, 2))
    rays, ok = unproject(CAMERA, pixels)
    assert ok.all()
    angles = np.arccos(rays @ boresight)
    assert 0.98 * half < angles.max() < half


def test_eq_3_8_the_cone_is_conservative_close_in() -> None:
    """At 1.5 times the maplet's own radius a flat half-side falls short of what can be seen; the ball does not."""
    index = index_on(SHAPE, 1, half=10, scale_km=0.2)
    radius = float(index.radius_km[0])
    place, frame = index.landmark_km[0], index.maplet_from_body[0]
    rng = np.random.default_rng(2)
    seen = kept = by_half_side = 0
    for _ in range(800):
        away = frame.T @ np.array([rng.normal(), rng.normal(), 0.4])
        position = place + away / np.linalg.norm(away) * 1.5 * radius
        view = look(position, place + rng.normal(size=3) * radius, rng.uniform(0, 6.28))
        steps = np.arange(-10, 11) * 0.2
        grid = place + steps[:, None, None] * frame[0] + steps[None, :, None] * frame[1]
        pixels, _ = view.pixels(grid.reshape(-1, 3))
        inside = ((pixels > -0.5) & (pixels < [299.5, 399.5])).all(axis=1).any()
        boresight, half = array_cone(CAMERA)
        cosine = boresight @ view.camera_from_body @ (place - position) / (1.5 * radius)
        if inside:
            seen += 1
            kept += bool(cone_test(view, index)[0])
            by_half_side += bool(np.arccos(cosine) < half + np.arctan(10.5 * 0.2 / (1.5 * radius)))
    assert seen == kept > 100
    assert by_half_side < seen


def test_eq_3_10_a_wide_cone_and_a_maplet_around_the_camera_are_kept() -> None:
    index = index_on(SHAPE, 1, half=40, scale_km=0.2)
    place = index.landmark_km[0]
    outward = index.maplet_from_body[0, 2]
    near = look(place + outward * 0.5, place + outward * 50.0, 0.0)
    assert cone_test(near, index).all()
    # A wide array beside a near maplet: the sum of both cones reaches far behind the camera's plane.
    wide = CameraModel((200, 200), 1.0, np.diag([2.0, 2.0]), np.array([99.5, 99.5]))
    ball = float(index.radius_km[0]) + 0.2 * np.sqrt(0.5)
    half = array_cone(wide)[1]
    reach = half + np.arcsin(1 / 1.02)
    assert half > 1.5
    assert reach > 2.8
    position = place + outward * ball * 1.02
    across = index.maplet_from_body[0, 0]
    for angle, kept in ((reach - 0.01, True), (reach + 0.01, False)):
        target = position - outward * np.cos(angle) + across * np.sin(angle)
        assert cone_test(look(position, target, 0.0, wide), index).tolist() == [kept]


def test_eq_3_11_the_cone_loses_none_that_nine_points_keep() -> None:
    rng = np.random.default_rng(3)
    index = index_on(SHAPE, 60, half=20, scale_km=0.05)
    kept = lost = dropped = 0
    for _ in range(400):
        view = random_view(rng)
        nine, cone = nine_point_test(view, index, 0.5), cone_test(view, index)
        kept += int(nine.sum())
        lost += int((nine & ~cone).sum())
        dropped += int((~cone).sum())
    assert lost == 0
    assert kept > 1000
    # It is of use: most of what it drops is dropped rightly.
    assert dropped > 0.3 * 400 * 60


def test_eq_3_12_and_3_13_facing_and_sun_have_configured_thresholds() -> None:
    index = index_on(SHAPE, 400)
    view = look(np.array([0.0, -60.0, 10.0]), np.zeros(3), 0.3)
    found = cull(view, index, None, CullingOptions(least_facing=0.4, least_sun=0.5, numlm=1000))
    sight = index.landmark_km - view.position_km
    facing = -(sight * index.maplet_from_body[:, 2]).sum(axis=1) / np.linalg.norm(sight, axis=1)
    sun = index.maplet_from_body[:, 2] @ view.sun
    outside = found.reason == MapletReason.OUTSIDE_CONE
    assert np.array_equal(found.reason == MapletReason.FACING_AWAY, ~outside & (facing <= 0.4))
    assert np.array_equal(found.reason == MapletReason.NOT_SUNLIT, ~outside & (facing > 0.4) & (sun <= 0.5))


def test_eq_3_14_and_3_56_resolution_is_a_length_not_an_area() -> None:
    index = index_on(SHAPE, 1, scale_km=0.02)
    outward = index.maplet_from_body[0, 2]
    camera = CameraModel((400, 400), 100.0, np.diag([50.0, 50.0]), np.array([199.5, 199.5]))
    view = look(index.landmark_km[0] + outward * 100.0, index.landmark_km[0], 0.4, camera)
    jacobian = maplet_jacobian(view, index, np.array([0]))
    # Straight down, a pixel is distance / (focal length in pixels) wide: 0.02 km, one cell.
    assert cells_per_pixel(jacobian) == pytest.approx([1.0], rel=1e-6)
    near = look(index.landmark_km[0] + outward * 25.0, index.landmark_km[0], 0.4, camera)
    assert cells_per_pixel(maplet_jacobian(near, index, np.array([0]))) == pytest.approx([0.25], rel=1e-5)


def test_eq_3_14_resolution_counts_from_numlm_on() -> None:
    index = index_on(SHAPE, 300, half=5)
    view = look(np.array([0.0, -60.0, 10.0]), np.zeros(3), 0.3)
    free = cull(view, index, None, CullingOptions(numlm=1000))
    strict = cull(view, index, None, CullingOptions(numlm=7, resolution_min=100.0, resolution_max=200.0))
    assert strict.used.tolist() == free.used[:7].tolist()
    assert (strict.reason == MapletReason.RESOLUTION).sum() == len(free.used) - 7


def test_eq_3_16_a_maplet_larger_than_the_frame_is_dropped() -> None:
    index = index_on(SHAPE, 1, half=200, scale_km=0.02)
    outward = index.maplet_from_body[0, 2]
    camera = CameraModel((400, 400), 100.0, np.diag([50.0, 50.0]), np.array([199.5, 199.5]))
    options = CullingOptions()
    sun = outward
    for distance, reason in ((105.0, MapletReason.USED), (95.0, MapletReason.LARGER_THAN_FRAME)):
        view = look(index.landmark_km[0] + outward * distance, index.landmark_km[0], 0.0, camera)
        lit = MapletView(camera, view.camera_from_body, view.position_km, sun)
        assert cull(lit, index, None, options).reason[0] == reason


def test_eq_3_17_the_fraction_is_what_may_be_lost() -> None:
    index = index_on(SHAPE, 1, half=50, scale_km=0.02)
    outward, x = index.maplet_from_body[0, 2], index.maplet_from_body[0, 0]
    camera = CameraModel((400, 400), 100.0, np.diag([50.0, 50.0]), np.array([199.5, 199.5]))
    # The landmark lies 20 cells beyond the array's edge, along the maplet's x axis.
    view = look(index.landmark_km[0] + outward * 100.0, index.landmark_km[0], 0.0, camera)
    turn = np.stack([x, np.cross(-outward, x), -outward])
    shifted = MapletView(camera, turn, view.position_km + 0.02 * 220.0 * x, view.sun)
    assert nine_point_test(shifted, index, 0.1).tolist() == [False]
    assert nine_point_test(shifted, index, 0.25).tolist() == [True]


def test_occlusion_loses_none_that_the_document_sees() -> None:
    rng = np.random.default_rng(5)
    index = index_on(SHAPE, 25)
    cells = icq_cells(ICQ)
    allowance = 0.01 * SHAPE.diameter_km
    hidden_count = 0
    for _ in range(20):
        view = random_view(rng)
        hidden = occlusion_test(view, index.landmark_km, TREE, allowance)
        for place, is_hidden in zip(index.landmark_km, hidden, strict=True):
            sight = place - view.position_km
            distance = float(np.linalg.norm(sight))
            first, _ = first_patch_hit(cells, view.position_km, sight / distance)
            assert is_hidden == (first < distance - allowance)
            hidden_count += int(is_hidden)
    assert 100 < hidden_count < 400


def test_reasons_add_up_and_later_tests_see_less() -> None:
    index = index_on(SHAPE, 500)
    rng = np.random.default_rng(6)
    met: set[int] = set()
    for _ in range(60):
        found = cull(random_view(rng), index, (TREE, SHAPE.diameter_km), CullingOptions(numlm=5))
        counts = np.bincount(found.reason, minlength=8)
        assert counts.sum() == len(index)
        assert counts[0] == len(found.used)
        assert np.isfinite(found.predicted_vu[found.used]).all()
        assert np.isfinite(found.jacobian[found.used]).all()
        met |= set(np.flatnonzero(counts).tolist())
    assert met >= {0, 1, 2, 3, 5, 6, 7}


def test_fifty_thousand_maplets_are_culled_quickly() -> None:
    index = index_on(SHAPE, 50_000)
    view = look(np.array([0.0, -60.0, 10.0]), np.zeros(3), 0.3)
    options = CullingOptions(numlm=50_000)
    seconds = []
    for _ in range(4):
        start = time.process_time()
        cull(view, index, None, options)
        seconds.append(time.process_time() - start)
    start = time.process_time()
    used = cull(view, index, (TREE, SHAPE.diameter_km), options).used
    with_rays = time.process_time() - start
    assert len(used) > 2000
    # Twice what is asked for on a quiet machine.
    assert min(seconds) < 0.12
    assert (with_rays - min(seconds)) / len(used) < 1e-3
