"""Triangle meshes against traced spheres: faces, occlusion and shadows that a mesh throws on itself."""

import numpy as np
import pytest

from pipeline.imaging.illumination import LAMBERT
from pipeline.imaging.mesh import MeshSolid, render_meshes
from pipeline.imaging.render import Cells, Window, blur
from pipeline.records import Body, FloatArray
from tests.scenes.body_scene import body_at, camera_of, seen, trace

SHAPE = (64, 64)
WINDOW = Window(0, 0, *SHAPE)
CAMERA = camera_of(SHAPE)
SIGMA = 0.8
OVER = 8
Triangles = tuple[FloatArray, np.ndarray]


def _sphere(polar: int, around: int) -> Triangles:
    """Unit sphere by latitude and longitude, outward counter-clockwise."""
    theta = np.linspace(0.0, np.pi, polar + 1)[1:-1, None]
    phi = 2.0 * np.pi * np.arange(around)[None, :] / around
    rings = np.stack(
        np.broadcast_arrays(np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)), axis=2
    )
    points = np.concatenate([[[0.0, 0.0, 1.0]], rings.reshape(-1, 3), [[0.0, 0.0, -1.0]]])
    k = np.arange(around)
    after = (k + 1) % around
    facets = [np.stack([0 * k, 1 + k, 1 + after], axis=1)]
    for row in range(polar - 2):
        a, b = 1 + row * around + k, 1 + row * around + after
        facets += [np.stack([a, a + around, b], axis=1), np.stack([b, a + around, b + around], axis=1)]
    last = len(points) - 1
    facets.append(np.stack([0 * k + last, last - around + after, last - around + k], axis=1))
    return points, np.concatenate(facets)


def _image(triangles: Triangles, sun: FloatArray, window: Window = WINDOW) -> tuple[FloatArray, FloatArray]:
    """Blurred light and cover of triangles in the camera frame, through the test's own pinhole."""
    points, facets = triangles
    uv = points[:, :2] / points[:, 2:] * CAMERA.focal_length_mm @ CAMERA.k_px_per_mm.T
    pixels = uv[:, ::-1] + CAMERA.principal_point_vu
    cells = Cells.blank(window, 2)
    render_meshes(cells, [MeshSolid(points, pixels, facets, sun, LAMBERT, 0.0)], window)
    template = blur(cells, window, SIGMA)
    return template.image.astype(float), template.cover.astype(float)


def _placed(centre: FloatArray, radius: float, triangles: Triangles) -> Triangles:
    return centre + radius * triangles[0], triangles[1]


def _joined(*parts: Triangles) -> Triangles:
    start = np.cumsum([0, *(len(p) for p, _ in parts[:-1])])
    return np.concatenate([p for p, _ in parts]), np.concatenate(
        [f + s for (_, f), s in zip(parts, start, strict=True)]
    )


@pytest.mark.parametrize("phase_deg", [5.0, 60.0, 120.0])
def test_a_fine_sphere_is_what_traced_rays_show(phase_deg: float) -> None:
    body = body_at(CAMERA, (31.2, 30.7), 20.0, phase_deg)
    light, cover = trace((body,), CAMERA, np.eye(3), OVER)
    mesh = _placed(body.position_km, float(body.radii_km[0]), _sphere(90, 180))
    image, covered = _image(mesh, body.sun_direction_j2000)
    truth = seen(light, OVER, SIGMA)
    # Cells of half a pixel are in or out: a quarter of a pixel of limb, less what the blur averages.
    for mine, expected in ((image, truth), (covered, seen(cover, OVER, SIGMA))):
        assert np.abs(mine - expected).max() < 0.1
        assert np.sqrt(((mine - expected) ** 2).mean()) < 8e-3
    # Where the limb runs along the cells a row of them errs together; a crescent has little else.
    for axis in np.indices(SHAPE):
        moved = (image * axis).sum() / image.sum() - (truth * axis).sum() / truth.sum()
        assert abs(moved) < (0.03 if phase_deg < 90.0 else 0.1)


def test_a_part_of_a_mesh_hides_and_shades_another() -> None:
    large = body_at(CAMERA, (32.0, 34.0), 18.0, 45.0, 0.0, name="LARGE")
    sun, radius = large.sun_direction_j2000, float(large.radii_km[0])
    small = large.position_km + 1.8 * radius * (sun + np.array([0.0, 0.1, 0.0]))
    other = Body("SMALL", None, small, np.full(3, 0.3 * radius), np.eye(3), sun)
    fine = _sphere(70, 140)
    both = _joined(_placed(large.position_km, radius, fine), _placed(small, 0.3 * radius, fine))
    image, _ = _image(both, sun)
    light, _ = trace((large, other), CAMERA, np.eye(3), OVER)
    alone, _ = trace((large,), CAMERA, np.eye(3), OVER)
    truth = seen(light, OVER, SIGMA)
    # The shadow is there, and where rays find it.
    assert np.abs(truth - seen(alone, OVER, SIGMA)).max() > 0.5
    assert np.sqrt(((image - truth) ** 2).mean()) < 0.02
    dark = seen(alone, OVER, SIGMA) - truth > 0.4
    assert float(image[dark].mean()) == pytest.approx(float(truth[dark].mean()), abs=0.04)


@pytest.mark.parametrize("phase_deg", [5.0, 85.0, 120.0])
def test_no_facet_shades_itself(phase_deg: float) -> None:
    """In grazing light a surface rises by many cells of the shadow map from one to the next."""
    body = body_at(CAMERA, (31.2, 30.7), 20.0, phase_deg)
    mesh = _placed(body.position_km, float(body.radii_km[0]), _sphere(90, 180))
    image, _ = _image(mesh, body.sun_direction_j2000)
    light, _ = trace((body,), CAMERA, np.eye(3), OVER)
    # Facets are flat and cells are in or out: some thousandths of the light.
    assert float(image.sum()) == pytest.approx(float(seen(light, OVER, SIGMA).sum()), rel=4e-3)


def test_a_mesh_partly_or_wholly_outside_the_window() -> None:
    body = body_at(CAMERA, (31.0, 31.0), 20.0, 40.0)
    mesh = _placed(body.position_km, float(body.radii_km[0]), _sphere(60, 120))
    whole, _ = _image(mesh, body.sun_direction_j2000)
    part, _ = _image(mesh, body.sun_direction_j2000, Window(20, 25, 30, 50))
    # The part has no light from beyond its border, to which the blur reaches four sigmas.
    assert np.abs(part[4:-4, 4:35] - whole[24:46, 29:60]).max() < 1e-4
    outside, cover = _image(mesh, body.sun_direction_j2000, Window(100, 100, 20, 20))
    assert not outside.any()
    assert not cover.any()


def test_facets_are_seen_from_outside_only() -> None:
    points = np.array([[-0.5, -0.5, 100.0], [0.5, -0.5, 100.0], [0.0, 0.6, 100.0]])
    sun = np.array([0.0, 0.0, -1.0])
    # Counter-clockwise for a camera that looks along +z is clockwise in (x, y).
    image, cover = _image((points, np.array([[0, 2, 1]])), sun)
    assert float(image.max()) > 0.99
    assert float(cover.sum()) == pytest.approx(0.55 * (2000.0 / 100.0) ** 2, rel=0.03)
    assert not _image((points, np.array([[0, 1, 2]])), sun)[1].any()
    # Lit from behind it is covered and dark.
    image, cover = _image((points, np.array([[0, 2, 1]])), -sun)
    assert not image.any()
    assert float(cover.max()) > 0.99
