"""Cameras: project world points to pixels, and return the world ray through a pixel.

Pixel (i, j), column i and row j from the top left, covers [i, i+1) × [j, j+1); its centre is at (i+½, j+½).
In camera axes x runs right, y down and z forward. The depth of a point is its z in these axes. A camera sees
points of positive depth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, cast, get_args

import numpy as np
import numpy.typing as npt

from octex.arrays import Float64s
from octex.cameras.differentials import differentials
from octex.cameras.lens import COUNTS, DISTORTION_MODELS, DistortionModel, distort, lens_numbers, undistort
from octex.checks import as_choice, as_number, as_points, as_positive, as_reals, as_whole, is_several, locked
from octex.errors import ArgumentError

#: Meaning of a pose matrix. ``opengl``: camera-to-world; the camera looks along −z, +y is up (glTF, Blender,
#: transforms.json). ``opencv``: world-to-camera; the camera looks along +z, +y is down (OpenCV, COLMAP).
Convention = Literal["opengl", "opencv"]

#: Coefficients in the order of `DistortionModel`.
Distortion = tuple[float, ...]
NO_DISTORTION: Distortion = (0.0, 0.0, 0.0, 0.0)

#: Whether rays meet in the camera's position or are parallel.
ProjectionKind = Literal["pinhole", "orthographic"]

#: Bounds of a camera's numbers: their powers stay far from overflow and underflow.
LARGEST, SMALLEST = 1e30, 1e-30
#: Largest image side, in pixels.
LARGEST_SIZE = 1_000_000
_MOST_DIMENSIONS = 9
#: Smallest distance of a field of view from 0° and from 180°, in degrees.
_LEAST_ANGLE = 1e-6

#: Between OpenGL's camera axes and ours, either way.
FLIP_YZ = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole or orthographic camera; a pinhole camera may have lens distortion.

    Make one with ``Camera.pinhole``, ``Camera.orthographic`` or ``Camera.fitted``.

    width, height     image size in pixels
    K                 (3, 3), to pixel coordinates. pinhole: K · (x/z, y/z, 1); orthographic: K · (x, y, 1)
    world_to_camera   (4, 4): a rotation and a translation into camera axes (x right, y down, z forward)
    distortion        coefficients of the lens, which moves (x/z, y/z) before K; zeros if orthographic
    distortion_model  ``opencv``: k1, k2, p1, p2 (radial and tangential), or also k3, k4, k5, k6 (rational);
                      ``fisheye``: k1, k2, k3, k4 of OpenCV's fisheye model, or
                      k1, k2, p1, p2, k3, k4, sx1, sy1 of COLMAP's THIN_PRISM_FISHEYE; ``fov``: ω

    The camera copies matrices and makes them read-only. Raises ArgumentError for other shapes, values and
    names.
    """

    width: int
    height: int
    K: Float64s
    world_to_camera: Float64s
    projection: ProjectionKind
    distortion: Distortion = NO_DISTORTION
    distortion_model: DistortionModel = "opencv"

    def __post_init__(self) -> None:
        checked = {
            "width": as_whole(self.width, "width", 1, LARGEST_SIZE),
            "height": as_whole(self.height, "height", 1, LARGEST_SIZE),
            "K": locked(_as_intrinsics(self.K)),
            "world_to_camera": locked(_as_rigid(self.world_to_camera, "world_to_camera")),
            "projection": as_choice(self.projection, get_args(ProjectionKind), "projection"),
            "distortion_model": as_choice(self.distortion_model, DISTORTION_MODELS, "distortion_model"),
            "distortion": _as_distortion(self.distortion, self.distortion_model),
        }
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        if self.projection == "orthographic" and self.is_distorted:
            raise ArgumentError("an orthographic camera must have no distortion")

    @classmethod
    def pinhole(
        cls,
        size: tuple[int, int],
        *,
        pose: npt.ArrayLike,
        convention: Convention,
        K: npt.ArrayLike | None = None,
        focal: float | tuple[float, float] | None = None,
        center: tuple[float, float] | None = None,
        distortion: Sequence[float] | None = None,
        distortion_model: DistortionModel = "opencv",
    ) -> Camera:
        """Make a perspective camera.

        size         (width, height) in pixels
        pose         (4, 4) or (3, 4) matrix, a rotation and a translation
        convention   "opengl": camera-to-world, looking along −z with +y up (glTF, Blender); "opencv":
                     world-to-camera, looking along +z with +y down (OpenCV, COLMAP)
        K            (3, 3) intrinsics in pixels; or instead of it
        focal        focal length in pixels, one number or (x, y), and
        center       principal point in pixels; default: the middle of the image
        distortion   coefficients in the order of ``distortion_model``; ``opencv`` also takes k1, k2 alone, or
                     k1, k2, p1, p2, k3; default: none

        Raises ArgumentError for a matrix that is not a pose or not intrinsics, for a wrong number of
        coefficients, and unless exactly one of K and focal is given.
        """
        width, height = as_size(size)
        if (K is None) == (focal is None) or (K is not None and center is not None):
            raise ArgumentError("give a pinhole camera either K, or focal with or without center")
        if K is None:
            x, y = np.broadcast_to(as_reals(cast(float, focal), "focal", (), (2,)), 2).tolist()
            middle = _as_center(center, width, height)
            K = intrinsics(as_positive(x, "focal"), as_positive(y, "focal"), *middle)
        return cls(
            width,
            height,
            _as_intrinsics(K),
            _as_view(pose, convention),
            "pinhole",
            NO_DISTORTION if distortion is None else cast(Distortion, distortion),
            distortion_model,
        )

    @classmethod
    def orthographic(
        cls,
        size: tuple[int, int],
        *,
        pose: npt.ArrayLike,
        convention: Convention,
        pixels_per_unit: float,
        center: tuple[float, float] | None = None,
    ) -> Camera:
        """Make a camera with parallel rays; 1 unit spans ``pixels_per_unit`` pixels. See ``pinhole``."""
        width, height = as_size(size)
        scale = as_positive(pixels_per_unit, "pixels_per_unit")
        K = intrinsics(scale, scale, *_as_center(center, width, height))
        return cls(width, height, _as_intrinsics(K), _as_view(pose, convention), "orthographic")

    @classmethod
    def fitted(
        cls,
        points: npt.ArrayLike,
        direction: npt.ArrayLike,
        *,
        size: tuple[int, int],
        fov: float = 30.0,
        up: npt.ArrayLike = (0.0, 1.0, 0.0),
        margin: float = 0.05,
    ) -> Camera:
        """Make the closest pinhole camera that sees all of ``points``, centred.

        points       (n, 3), for example a model's vertices
        direction    from the model toward the camera
        fov          the angle, in degrees, across the shorter side of the image
        up           direction that points up in the image; another axis if it is parallel to ``direction``
        margin       free border on each side, as a fraction of width and height

        Raises ArgumentError for an empty array, non-finite points, a direction of length 0, or an angle or
        margin out of range.
        """
        width, height = as_size(size)
        points = as_points(points).astype(np.float64, copy=False)
        if not points.size or not (np.abs(points) <= LARGEST).all():
            raise ArgumentError(f"points must be finite, up to {LARGEST:g}, and at least one")
        fov, margin = as_number(fov, "fov", 0.0, 180.0), as_number(margin, "margin", 0.0, 0.5)
        if not _LEAST_ANGLE <= fov <= 180.0 - _LEAST_ANGLE:
            raise ArgumentError(
                f"fov must be at least {_LEAST_ANGLE:g} degrees away from 0 and 180, not {fov:g}"
            )
        if margin == 0.5:
            raise ArgumentError("margin must be at least 0 and below 0.5")
        rotation = _look_along(-as_vector(direction, "direction"), as_vector(up, "up"))

        focal = min(width, height) / 2 / np.tan(np.radians(fov) / 2)
        x, y, z = rotation @ points.T
        slope_x, slope_y = (0.5 - margin) * width / focal, (0.5 - margin) * height / focal
        eye_x, back_x = _fit_wedge(x, z, slope_x)
        eye_y, back_y = _fit_wedge(y, z, slope_y)
        extent = float(np.ptp(points, axis=0).max()) or 1.0
        eye = np.array([eye_x, eye_y, min(back_x, back_y, float(z.min()) - 1e-3 * extent)])

        view = np.eye(4)
        view[:3, :3] = rotation
        view[:3, 3] = -eye
        return cls(width, height, intrinsics(focal, focal, width / 2, height / 2), view, "pinhole")

    def zoomed(self, times: float) -> Camera:
        """Return the camera with the image enlarged by ``times`` about its middle.

        Raises ArgumentError for a number that is not above zero.
        """
        times = as_positive(times, "times")
        K, middle = self.K.copy(), np.array([self.width, self.height]) / 2
        K[:2, :2] *= times
        K[:2, 2] = middle + times * (K[:2, 2] - middle)
        return replace(self, K=K)

    @property
    def position(self) -> Float64s:
        """Return the camera's position in the world (3,)."""
        return -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]

    @property
    def matrix(self) -> Float64s:
        """Return the matrix (4, 4) from (x, y, z, 1) to (i·w, j·w, w, depth) with pixel coordinates (i, j).

        It ignores lens distortion, which no matrix can express.
        """
        view = self.world_to_camera
        last = view[2] if self.projection == "pinhole" else np.array([0.0, 0.0, 0.0, 1.0])
        return np.vstack([self.K[:2] @ np.vstack([view[:2], last]), last, view[2]])

    @property
    def undistorted(self) -> Camera:
        """The same camera without lens distortion."""
        return replace(self, distortion=NO_DISTORTION, distortion_model="opencv")

    @property
    def is_distorted(self) -> bool:
        """Whether the lens has any distortion."""
        return self.distortion_model == "fisheye" or any(self.distortion)

    @cached_property
    def lens(self) -> Float64s:
        """The distortion in the form that kernels read: `octex.cameras.lens.lens_numbers`."""
        return lens_numbers(self.distortion_model, self.distortion)

    def distort(self, points: npt.ArrayLike) -> Float64s:
        """Return normalised coordinates (x/z, y/z), (n, 2), as the lens distorts them.

        They are NaN far from the axis, where radial distortion would fold points back into the image.
        """
        points = np.ascontiguousarray(as_reals(points, "points", (-1, 2)), np.float64)
        distorted = np.empty_like(points)
        with np.errstate(all="ignore"):
            distort(self.lens, points, distorted)
        return distorted

    def project(self, points: npt.ArrayLike) -> tuple[Float64s, Float64s]:
        """Return the pixel coordinates (n, 2) and depths (n,) of world points (n, 3).

        Coordinates are NaN where a pinhole camera's depth is not above zero or ``distort`` gives NaN.
        """
        points = as_points(points)
        with np.errstate(over="ignore", invalid="ignore"):  # points may be non-finite or huge
            if not self.is_distorted:
                x, y, w, depth = self.matrix[:, :3] @ points.T + self.matrix[:, 3:]
                w = np.where(w > 0.0, w, np.nan)
                return np.column_stack([x / w, y / w]), depth
            x, y, depth = self.world_to_camera[:3, :3] @ points.T + self.world_to_camera[:3, 3:]
            z = np.where(depth > 0.0, depth, np.nan)
            return self.distort(np.column_stack([x / z, y / z])) @ self.K[:2, :2].T + self.K[:2, 2], depth

    def rays(self, pixels: npt.ArrayLike) -> tuple[Float64s, Float64s]:
        """Return rays through pixel coordinates (n, 2): origins at depth 0 and unit directions, (n, 3).

        Directions are NaN for pixels that the lens maps no point to.
        """
        pixels = as_reals(pixels, "pixels", (-1, 2))
        on_plane = np.linalg.solve(self.K, np.column_stack([pixels, np.ones(len(pixels))]).T).T
        with np.errstate(over="ignore", invalid="ignore"):  # pixels may be non-finite or huge
            if self.projection == "pinhole":
                if self.is_distorted:
                    bent = np.ascontiguousarray(on_plane[:, :2])
                    undistorted = np.empty_like(bent)
                    undistort(self.lens, bent, undistorted)
                    on_plane[:, :2] = undistorted
                origins, directions = np.zeros_like(on_plane), on_plane
            else:
                origins, directions = on_plane * [1.0, 1.0, 0.0], np.tile([0.0, 0.0, 1.0], (len(pixels), 1))
            rotation, translation = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
            directions = directions @ rotation
            lengths = np.linalg.norm(directions, axis=1, keepdims=True)
            return (origins - translation) @ rotation, directions / lengths

    def differentials(self, points: npt.ArrayLike, normals: npt.ArrayLike) -> tuple[Float64s, Float64s]:
        """Return the world steps of visible surface points (n, 3) for one pixel to the right and one down.

        It takes the surface at a point as a plane with normal ``normals`` (n, 3), at least 0.06° from edge-on
        (Igehy, "Tracing Ray Differentials", 1999). It ignores lens distortion.
        """
        points = as_points(points).astype(np.float64, copy=False)
        normals = as_points(normals, "normals").astype(np.float64, copy=False)
        if len(points) != len(normals):
            raise ArgumentError(f"there are {len(normals)} normals for {len(points)} points")
        right, down = np.empty((2, len(points), 3))
        differentials(self.eye, self.projection == "pinhole", points, normals, right, down)
        return right, down

    @property
    def eye(self) -> Float64s:
        """Rows (4, 3): position, axis, and the steps of one pixel to the right and down at depth 1."""
        rotation = self.world_to_camera[:3, :3]
        steps = (np.linalg.inv(self.K)[:, :2].T * [1.0, 1.0, 0.0]) @ rotation
        return np.vstack([self.position, rotation[2], steps])

    def pixel_width(self, depth: npt.ArrayLike) -> Float64s:
        """Return the world width of a pixel, across the view, at depths of any shape.

        It ignores lens distortion.
        """
        focal = np.sqrt(self.K[0, 0] * self.K[1, 1])
        depth = as_reals(depth, "depth", *((-1,) * n for n in range(_MOST_DIMENSIONS)))
        return depth / focal if self.projection == "pinhole" else np.full(depth.shape, 1.0 / focal)

    def scaled(self, factor: int) -> Camera:
        """Return the same view with ``factor`` times as many pixels in each direction."""
        factor = as_whole(factor, "factor", 1, LARGEST_SIZE)
        return self.resized((self.width * factor, self.height * factor))

    def resized(self, size: tuple[int, int]) -> Camera:
        """Return the same view at another ``size`` (width, height) in pixels."""
        width, height = as_size(size)
        K = np.diag([width / self.width, height / self.height, 1.0]) @ self.K
        return replace(self, width=width, height=height, K=K)


def intrinsics(focal_x: float, focal_y: float, center_x: float, center_y: float) -> Float64s:
    """Return the intrinsics (3, 3) of focal lengths and a principal point, in pixels."""
    return np.array([[focal_x, 0.0, center_x], [0.0, focal_y, center_y], [0.0, 0.0, 1.0]])


def as_size(size: tuple[int, int]) -> tuple[int, int]:
    """Return a checked width and height in pixels, or raise ArgumentError."""
    sides = list(size) if is_several(size) else []
    is_size = [isinstance(each, (int, np.integer)) and 0 < each <= LARGEST_SIZE for each in sides]
    if is_size != [True, True]:
        raise ArgumentError(f"size must be (width, height) in whole pixels above zero, not {size!r}")
    return int(sides[0]), int(sides[1])


def _as_center(center: npt.ArrayLike | None, width: int, height: int) -> tuple[float, float]:
    if center is None:
        return width / 2, height / 2
    x, y = as_reals(center, "center", (2,), most=LARGEST).tolist()
    return x, y


def as_vector(vector: npt.ArrayLike, name: str) -> Float64s:
    """Return the unit vector (3,) along a vector, or raise ArgumentError."""
    array = as_reals(vector, name, (3,), most=np.finfo(np.float64).max)
    largest = np.abs(array).max()
    if not largest > 0.0:
        raise ArgumentError(f"{name} must be three finite numbers, not all zero")
    array = np.ldexp(array, -np.frexp(largest)[1])  # squares of the scaled values neither overflow nor vanish
    return np.asarray(array / np.linalg.norm(array))


def _as_intrinsics(K: npt.ArrayLike) -> Float64s:
    matrix = as_reals(K, "K", (3, 3), most=LARGEST)
    if not (matrix[0, 0] >= SMALLEST and matrix[1, 1] >= SMALLEST):
        raise ArgumentError(
            f"K's focal lengths must be above zero, not {matrix[0, 0]:g} and {matrix[1, 1]:g}"
        )
    if matrix[1, 0] != 0.0 or (matrix[2] != [0.0, 0.0, 1.0]).any():
        raise ArgumentError("K must be upper triangular with the last row 0 0 1")
    return matrix


def _as_distortion(distortion: Sequence[float], model: DistortionModel) -> Distortion:
    numbers = as_reals(distortion, "distortion", *((count,) for count in COUNTS[model]), most=LARGEST)
    if model == "fov" and not abs(numbers[0]) < np.pi:
        raise ArgumentError(f"distortion of fov must be an angle of less than π, not {numbers[0]:g}")
    if model != "opencv":
        return tuple(numbers.tolist())
    whole = np.append(numbers, np.zeros(8 - len(numbers))).tolist()
    return tuple(whole if any(whole[4:]) else whole[:4])


def _as_view(pose: npt.ArrayLike, convention: Convention) -> Float64s:
    """Return a user's pose as a world-to-camera matrix in our camera axes."""
    as_choice(convention, get_args(Convention), "camera convention")
    matrix = as_reals(pose, "a camera's pose", (4, 4), (3, 4), most=LARGEST)
    if len(matrix) == 3:
        matrix = np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])
    rigid = _as_rigid(matrix, "a camera's pose")
    left, _, right = np.linalg.svd(matrix[:3, :3])
    rigid[:3, :3] = left @ right  # the nearest rotation, since files round to a few digits
    rigid[3] = [0.0, 0.0, 0.0, 1.0]
    return np.asarray(FLIP_YZ @ np.linalg.inv(rigid)) if convention == "opengl" else rigid


def _as_rigid(matrix: npt.ArrayLike, name: str) -> Float64s:
    values = as_reals(matrix, name, (4, 4), most=LARGEST)
    if not np.allclose(values[3], [0.0, 0.0, 0.0, 1.0]):
        raise ArgumentError(f"{name} must have the last row 0 0 0 1; is the matrix transposed?")
    if np.abs(np.linalg.svd(values[:3, :3])[1] - 1.0).max() > 1e-4:
        raise ArgumentError(f"{name} must not scale or shear: its upper left 3×3 must be a rotation")
    if np.linalg.det(values[:3, :3]) < 0.0:
        raise ArgumentError(f"{name} must not mirror; is one of its axes negated?")
    return values


def _look_along(forward: Float64s, up: Float64s) -> Float64s:
    """Return a rotation from the world to camera axes (x right, y down, z forward)."""
    if abs(forward @ up) > 0.999:
        up = -np.eye(3)[(np.argmax(np.abs(up)) + 1) % 3]
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def _fit_wedge(across: Float64s, along: Float64s, slope: float) -> tuple[float, float]:
    """Return the foremost apex (a, b) of a wedge |across − a| ≤ slope · (along − b) that holds all points."""
    right = float((across - slope * along).max())
    left = float((-across - slope * along).max())
    return (right - left) / 2, -(right + left) / (2 * slope)
