"""Rendering of lit bodies onto a pixel grid, blurred by the point spread: templates with their exact derivatives.

Cells (whole pixels, or a fraction of one) hold the mean radiance of the surface under them; where a limb crosses a
cell it is sampled more finely. A discrete Gaussian then stands for the optics and the mean over a pixel's cells for the
detector. Derivatives with respect to a shift are taken by the Gaussian's derivative, not by differences of pixels,
which would flatten a sharp limb by a third.
"""

from dataclasses import dataclass
from math import ceil, sqrt

import cv2
import numba
import numpy as np

from pipeline.camera import unproject
from pipeline.imaging.illumination import reflectance
from pipeline.records import CameraModel, FloatArray, Image, Record

# Pixels between the rays that are computed exactly; between them distortion is bilinear to 2e-3 px.
RAY_SPACING_PX = 16
# Samples along each side of a cell that the limb crosses.
_LIMB_SAMPLES = 5
# Below this core, in cells, a sampled Gaussian no longer stands for a continuous one (error 0.3 % at 0.54).
_LEAST_SIGMA_CELLS = 0.5
# Below this diameter the limb has too few pixels for the errors of sampling to average out.
_SMALL_PX = 150.0


@dataclass(frozen=True)
class Window:
    """Rectangle of whole pixels: its first row and column (may lie outside the array), rows and columns."""

    v0: int
    u0: int
    rows: int
    cols: int

    def slices_in(self, other: "Window") -> tuple[slice, slice]:
        """Rows and columns of this window inside an array that covers another one, clipped to it."""
        top, left = max(self.v0 - other.v0, 0), max(self.u0 - other.u0, 0)
        bottom = min(self.v0 + self.rows - other.v0, other.rows)
        right = min(self.u0 + self.cols - other.u0, other.cols)
        return slice(top, max(bottom, top)), slice(left, max(right, left))

    def intersection(self, other: "Window") -> "Window":
        """Common part, empty (zero rows or columns) where there is none."""
        top, left = max(self.v0, other.v0), max(self.u0, other.u0)
        bottom = min(self.v0 + self.rows, other.v0 + other.rows)
        right = min(self.u0 + self.cols, other.u0 + other.cols)
        return Window(top, left, max(bottom - top, 0), max(right - left, 0))

    def grown(self, by_v: int, by_u: int) -> "Window":
        """Wider by so many pixels on each side."""
        return Window(self.v0 - by_v, self.u0 - by_u, self.rows + 2 * by_v, self.cols + 2 * by_u)

    @property
    def pixels(self) -> int:
        """Area."""
        return self.rows * self.cols


@dataclass(frozen=True, eq=False)
class RayGrid(Record):
    """Rays (x/z, y/z) at every sixteenth pixel of a window, one more on each side than it needs.

    Attributes
    ----------
    window
        Pixels that it serves.
    slopes
        (grid rows, grid cols, 2); not-a-number where the camera model has no inverse.
    """

    window: Window
    slopes: FloatArray

    def __post_init__(self) -> None:
        self._freeze(slopes=(None, None, 2))


def ray_grid(camera: CameraModel, window: Window) -> RayGrid:
    """Rays through a window's pixels.

    Parameters
    ----------
    camera
        Model.
    window
        Pixels, also outside the array.

    Returns
    -------
    RayGrid
        For :func:`render_cells`.
    """
    v = window.v0 - RAY_SPACING_PX + RAY_SPACING_PX * np.arange(window.rows // RAY_SPACING_PX + 4)
    u = window.u0 - RAY_SPACING_PX + RAY_SPACING_PX * np.arange(window.cols // RAY_SPACING_PX + 4)
    pixels = np.stack(np.meshgrid(v, u, indexing="ij"), axis=2).reshape(-1, 2).astype(float)
    if camera.distortion_eps.any() or camera.k_xy_px_per_mm2.any():
        rays, ok = unproject(camera, pixels)
        slopes = np.where(ok[:, None], rays[:, :2] / rays[:, 2:], np.nan)
    else:
        photo = (pixels - camera.principal_point_vu)[:, ::-1] @ np.linalg.inv(camera.k_px_per_mm).T
        slopes = photo / camera.focal_length_mm
    return RayGrid(window, slopes.reshape(len(v), len(u), 2))


@dataclass(frozen=True, eq=False)
class Solid(Record):
    """A body ready for rendering, in the camera frame.

    Attributes
    ----------
    centre_km
        (3,) from the camera.
    form
        (3, 3) B with ``x B x = 1`` on the surface, x from the centre, per km^2.
    sun
        (3,) unit vector toward the Sun.
    law, parameter
        Scattering law, see ``illumination.law_of``.
    shadowed_by
        (m, 12) centre and rows of the form of bodies that may stand between it and the Sun.
    """

    centre_km: FloatArray
    form: FloatArray
    sun: FloatArray
    law: int
    parameter: float
    shadowed_by: FloatArray

    def __post_init__(self) -> None:
        self._freeze(centre_km=(3,), form=(3, 3), sun=(3,), shadowed_by=(None, 12))


@numba.njit(cache=True, nogil=True)
def _in_shadow(px, py, pz, sun, occluders):  # type: ignore[no-untyped-def]
    for k in range(occluders.shape[0]):
        o = occluders[k]
        ex, ey, ez = px - o[0], py - o[1], pz - o[2]
        bsx = o[3] * sun[0] + o[4] * sun[1] + o[5] * sun[2]
        bsy = o[6] * sun[0] + o[7] * sun[1] + o[8] * sun[2]
        bsz = o[9] * sun[0] + o[10] * sun[1] + o[11] * sun[2]
        a = sun[0] * bsx + sun[1] * bsy + sun[2] * bsz
        b = ex * bsx + ey * bsy + ez * bsz
        if b >= 0.0:
            continue
        bex = o[3] * ex + o[4] * ey + o[5] * ez
        bey = o[6] * ex + o[7] * ey + o[8] * ez
        bez = o[9] * ex + o[10] * ey + o[11] * ez
        if b * b - a * (ex * bex + ey * bey + ez * bez - 1.0) > 0.0:
            return True
    return False


@numba.njit(cache=True, nogil=True)
def _covered_share(value, along_v, along_u):  # type: ignore[no-untyped-def]
    """Share of a cell in which a plane is positive: its value in the middle, and its rise across the cell."""
    a, b = abs(along_v), abs(along_u)
    low, high = min(a, b), max(a, b)
    q = value + (a + b) / 2.0
    if q <= 0.0 or high == 0.0:
        return 0.0
    if q >= a + b:
        return 1.0
    if q < low:
        return q * q / (2.0 * a * b)
    if q <= high:
        return (q - low / 2.0) / high
    return 1.0 - (a + b - q) ** 2 / (2.0 * a * b)


@numba.njit(cache=True, nogil=True)
def _shade(ex, ey, disc, cx, cy, cz, bc, cbc, form, sun, law, parameter, occluders):  # type: ignore[no-untyped-def]
    """Radiance where a ray d = centre/z + e meets the body."""
    bex = form[0, 0] * ex + form[0, 1] * ey
    bey = form[1, 0] * ex + form[1, 1] * ey
    bez = form[2, 0] * ex + form[2, 1] * ey
    dbd = cbc / (cz * cz) + 2.0 * (ex * bc[0] + ey * bc[1]) / cz + ex * bex + ey * bey
    t = (cbc / cz + ex * bc[0] + ey * bc[1] - sqrt(disc)) / dbd
    # Normal B (t d - c) with d = c/z + e.
    f = t / cz - 1.0
    nx, ny, nz = f * bc[0] + t * bex, f * bc[1] + t * bey, f * bc[2] + t * bez
    norm = 1.0 / sqrt(nx * nx + ny * ny + nz * nz)
    mu0 = (nx * sun[0] + ny * sun[1] + nz * sun[2]) * norm
    if mu0 <= 0.0:
        return 0.0
    rx, ry = cx + ex, cy + ey
    if occluders.shape[0] and _in_shadow(t * rx, t * ry, t, sun, occluders):
        return 0.0
    mu = -(nx * rx + ny * ry + nz) * norm / sqrt(rx * rx + ry * ry + 1.0)
    return reflectance(law, parameter, mu0, mu)


@numba.njit(cache=True, nogil=True)
def _draw(cells, cover, slopes, over, inner, centre, form, sun, law, parameter, occluders):  # type: ignore[no-untyped-def]
    """Add one solid to the cells, in front of what they hold.

    The ray is written d = centre/z + e: then ``disc = cBc/z^2 + 2 e.Bc/z + (e.Bc)^2 - (cBc - 1) eBe`` has no
    difference of large numbers, however far the body is.
    """
    bc = form @ centre
    cbc = centre @ bc
    cz = centre[2]
    cx, cy = centre[0] / cz, centre[1] / cz
    rows, cols = cells.shape
    size = 1.0 / over
    step = size / RAY_SPACING_PX
    k0, kx, ky = cbc / (cz * cz), 2.0 * bc[0] / cz, 2.0 * bc[1] / cz
    q = cbc - 1.0
    mxx, mxy, myy = bc[0] ** 2 - q * form[0, 0], bc[0] * bc[1] - q * form[0, 1], bc[1] ** 2 - q * form[1, 1]
    for i in range(rows):
        gv = ((i + 0.5) * size - 0.5) / RAY_SPACING_PX + 1.0
        a = int(gv)
        fv = gv - a
        last = -1
        for j in range(cols):
            gu = ((j + 0.5) * size - 0.5) / RAY_SPACING_PX + 1.0
            b = int(gu)
            if b != last:
                # Slopes are linear inside a patch: value at its left border and derivatives per spacing.
                last = b
                x00, x01, x10, x11 = slopes[a, b, 0], slopes[a, b + 1, 0], slopes[a + 1, b, 0], slopes[a + 1, b + 1, 0]
                y00, y01, y10, y11 = slopes[a, b, 1], slopes[a, b + 1, 1], slopes[a + 1, b, 1], slopes[a + 1, b + 1, 1]
                x0, y0 = x00 + (x10 - x00) * fv - cx, y00 + (y10 - y00) * fv - cy
                xu, yu = (x01 - x00) * (1 - fv) + (x11 - x10) * fv, (y01 - y00) * (1 - fv) + (y11 - y10) * fv
                fu = gu - b
                xv, yv = (x10 - x00) * (1 - fu) + (x11 - x01) * fu, (y10 - y00) * (1 - fu) + (y11 - y01) * fu
            x, y = x0 + xu * (gu - b), y0 + yu * (gu - b)
            disc = k0 + x * (kx + mxx * x + 2.0 * mxy * y) + y * (ky + myy * y)
            dx, dy = kx + 2.0 * (mxx * x + mxy * y), ky + 2.0 * (mxy * x + myy * y)
            # The cell's corner is half a cell from its centre along each axis; curvature is granted as much again.
            rise_v, rise_u = step * (dx * xv + dy * yv), step * (dx * xu + dy * yu)
            reach = 1.1 * (abs(rise_v) + abs(rise_u))
            if not disc >= -reach:
                continue
            if disc > reach and inner == 1:
                light = _shade(x, y, disc, cx, cy, cz, bc, cbc, form, sun, law, parameter, occluders)
                cells[i, j] = light
                cover[i, j] = 1.0
                continue
            samples = inner if disc > reach else _LIMB_SAMPLES
            light, covered = 0.0, 0
            for m in range(samples):
                ov = ((m + 0.5) / samples - 0.5) * step
                for n in range(samples):
                    ou = ((n + 0.5) / samples - 0.5) * step
                    ex, ey = x + xv * ov + xu * ou, y + yv * ov + yu * ou
                    disc_here = k0 + ex * (kx + mxx * ex + 2.0 * mxy * ey) + ey * (ky + myy * ey)
                    if disc_here < 0.0:
                        continue
                    covered += 1
                    light += _shade(ex, ey, disc_here, cx, cy, cz, bc, cbc, form, sun, law, parameter, occluders)
            if covered:
                # Counting samples would make a limb ragged, and a ragged limb seems to show a rotation.
                share = _covered_share(disc, rise_v, rise_u) if disc <= reach else 1.0
                cells[i, j] = light / covered * share + (1.0 - share) * cells[i, j]
                cover[i, j] += (1.0 - cover[i, j]) * share


def cells_per_pixel(sigma_px: float, diameter_px: float) -> int:
    """How finely to draw: twice as fine for a sharp core or a small body, whose few limb pixels do not average out.

    Parameters
    ----------
    sigma_px
        Core of the point spread.
    diameter_px
        Largest body.

    Returns
    -------
    int
        Cells along a pixel's side.
    """
    need = ceil(_LEAST_SIGMA_CELLS / sigma_px)
    return max(need, 2 if diameter_px < _SMALL_PX else 1)


@dataclass(frozen=True, eq=False)
class Cells:
    """Canvas of a rendering, before any blur.

    Attributes
    ----------
    light
        (rows * over, cols * over) float32 radiance.
    cover
        Same shape, share of a cell that a body covers, lit or not.
    over
        Cells along a pixel's side.
    """

    light: Image
    cover: Image
    over: int

    @staticmethod
    def blank(window: Window, over: int) -> "Cells":
        """Sky over a window."""
        shape = (window.rows * over, window.cols * over)
        return Cells(np.zeros(shape, np.float32), np.zeros(shape, np.float32), over)


def render_cells(
    cells: Cells, solids: list[Solid], rays: RayGrid, window: Window, boxes: list[Window], inner: int = 1
) -> None:
    """Draw bodies over what the cells of a window hold, before any blur.

    Parameters
    ----------
    cells
        Changed in place.
    solids
        Bodies, farthest first: nearer ones hide what is behind them.
    rays
        Of a window that holds this one.
    window
        Pixels of the cells.
    boxes
        Pixels that each body can touch.
    inner
        Samples along a side of a cell that no limb crosses.
    """
    for solid, box in zip(solids, boxes, strict=True):
        # Compiled loops check no bounds: beyond the rays there is nothing to draw.
        part = box.intersection(window).intersection(rays.window)
        if not part.pixels:
            continue
        rows, cols = part.slices_in(window)
        over = cells.over
        inside = np.s_[rows.start * over : rows.stop * over, cols.start * over : cols.stop * over]
        _draw(
            cells.light[inside], cells.cover[inside], _grid_for(rays, part), over, inner, solid.centre_km, solid.form,
            solid.sun, solid.law, solid.parameter, solid.shadowed_by,
        )  # fmt: skip


def _grid_for(rays: RayGrid, part: Window) -> FloatArray:
    """Slopes re-sampled so that the grid starts one spacing before the part; linear, hence exact for a pinhole."""
    dv, du = part.v0 - rays.window.v0, part.u0 - rays.window.u0
    if dv % RAY_SPACING_PX == 0 and du % RAY_SPACING_PX == 0:
        return rays.slopes[dv // RAY_SPACING_PX :, du // RAY_SPACING_PX :]
    a, fv = divmod(dv / RAY_SPACING_PX, 1.0)
    b, fu = divmod(du / RAY_SPACING_PX, 1.0)
    grid = rays.slopes[int(a) :, int(b) :]
    rows = grid[:-1] * (1.0 - fv) + grid[1:] * fv if fv else grid
    return np.ascontiguousarray(rows[:, :-1] * (1.0 - fu) + rows[:, 1:] * fu if fu else rows)


@dataclass(frozen=True, eq=False)
class Template:
    """Predicted image and its derivatives, each (rows, cols) float32.

    Attributes
    ----------
    window
        Pixels that it covers.
    image
        Brightness 1 for a surface lit and seen from straight above.
    along_v, along_u
        Derivative of ``image`` with respect to v and u, per pixel.
    night
        Share of a pixel that unlit surface covers: its light (planetshine) is no part of ``image``.
    cover
        Share of a pixel that any surface covers, lit or not.
    widening
        Derivative of ``image`` with respect to the variance of the point spread, per px^2.
    spin
        Derivative of ``image`` with respect to a rotation of each body about its own centre, per radian; None where
        no rotation is asked for.
    """

    window: Window
    image: Image
    along_v: Image
    along_u: Image
    night: Image
    cover: Image
    widening: Image
    spin: Image | None = None

    def part(self, window: Window) -> "Template":
        """What covers a window inside the template's own."""
        rows, cols = window.slices_in(self.window)

        def cut(plane: Image) -> Image:
            return np.ascontiguousarray(plane[rows, cols])

        return Template(
            window, cut(self.image), cut(self.along_v), cut(self.along_u), cut(self.night), cut(self.cover),
            cut(self.widening), None if self.spin is None else cut(self.spin),
        )  # fmt: skip


def gaussian_kernels(sigma: float) -> tuple[FloatArray, FloatArray]:
    """Sampled Gaussian and its derivative, for correlation (as OpenCV filters).

    Parameters
    ----------
    sigma
        Cells.

    Returns
    -------
    tuple
        Kernel of unit sum; derivative kernel, exact for a linear ramp.
    """
    reach = max(1, ceil(4.0 * sigma))
    x = np.arange(-reach, reach + 1, dtype=float)
    smooth = np.exp(-0.5 * (x / sigma) ** 2)
    smooth /= smooth.sum()
    slope = x * smooth
    slope /= (slope * x).sum()
    return smooth, slope


def blur(cells: Cells, window: Window, sigma_px: float) -> Template:
    """Optics and detector: cells to a template.

    Parameters
    ----------
    cells
        Over the window.
    window
        Pixels.
    sigma_px
        Gaussian core, before integration over the pixel.

    Returns
    -------
    Template
        Over the same window; within four sigmas of its border the light from outside is missing.
    """
    over = cells.over
    smooth, slope = gaussian_kernels(sigma_px * over)
    bend = _second_derivative(sigma_px * over)
    image = _filtered(cells.light, smooth, smooth, window, over)
    along_v = _filtered(cells.light, slope, smooth, window, over) * np.float32(over)
    along_u = _filtered(cells.light, smooth, slope, window, over) * np.float32(over)
    # The blurred image obeys the heat equation: dT/d(variance) is half its Laplacian.
    laplacian = _filtered(cells.light, bend, smooth, window, over) + _filtered(cells.light, smooth, bend, window, over)
    night = _filtered(np.where(cells.light > 0.0, np.float32(0.0), cells.cover), smooth, smooth, window, over)
    cover = _filtered(cells.cover, smooth, smooth, window, over)
    return Template(window, image, along_v, along_u, night, cover, laplacian * np.float32(0.5 * over**2))


def blur_image(cells: Cells, window: Window, sigma_px: float) -> Image:
    """The image of :func:`blur` alone, for searches."""
    smooth, _ = gaussian_kernels(sigma_px * cells.over)
    return _filtered(cells.light, smooth, smooth, window, cells.over)


def _filtered(cells: Image, kernel_v: FloatArray, kernel_u: FloatArray, window: Window, over: int) -> Image:
    if not window.pixels:
        return np.zeros((window.rows, window.cols), np.float32)
    plane = cv2.sepFilter2D(cells, cv2.CV_32F, kernel_u, kernel_v, borderType=cv2.BORDER_REPLICATE)
    if over > 1:
        plane = cv2.resize(plane, (window.cols, window.rows), interpolation=cv2.INTER_AREA)
    return np.asarray(plane, np.float32)


def _second_derivative(sigma: float) -> FloatArray:
    """Kernel of the Gaussian's second derivative: zero on planes, exact on a parabola."""
    reach = max(1, ceil(4.0 * sigma))
    x = np.arange(-reach, reach + 1, dtype=float)
    smooth = np.exp(-0.5 * (x / sigma) ** 2)
    smooth /= smooth.sum()
    kernel = (x**2 - (smooth * x**2).sum()) * smooth
    return np.asarray(2.0 * kernel / (kernel * x**2).sum())
