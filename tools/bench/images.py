"""Benchmarks of images and materials: filters under stretched footprints, all channels of a model."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import numpy.typing as npt
from measuring import Report, Setup, clocked

import octex
from octex.channels import linear_to_srgb

Floats = npt.NDArray[np.floating]

_FILTERS = ("trilinear", "ewa")
_STRETCHES = (1, 2, 4, 8, 16)
_WIDTHS = (0.7, 1.5, 4.0)  # of the footprint's short side, in texels
_ANGLES = (0.0, 0.3, 0.8, 1.2)


def filters(setup: Setup, report: Report) -> None:
    """Image filters under stretched footprints: error beside the mean over the footprint, and time."""
    side, count, fine = (64, 20, 8) if setup.quick else (512, 300, 48)
    angles = _ANGLES[1::2] if setup.quick else _ANGLES
    report.title(f"filters: {side}² texels, footprints of {_WIDTHS} texels times the stretch, turned")
    rng = np.random.default_rng(0)
    errors: dict[str, dict[str, list[float]]] = {}
    for image, texels in _images(rng, side).items():
        errors[image] = {name: [] for name in _FILTERS}
        for stretch in _STRETCHES:
            squares = np.zeros(len(_FILTERS))
            for width in _WIDTHS:
                for angle in angles:
                    squares += _squared_errors(texels, stretch, width, angle, count, fine, rng)
            for name, square in zip(_FILTERS, squares, strict=True):
                errors[image][name].append(float(np.sqrt(square / (len(_WIDTHS) * len(angles)))))
    times = _times(setup, side)
    heads = ["RMS, sRGB codes; stretch", *(f"{stretch} : 1" for stretch in _STRETCHES)]
    rows = [
        [f"{image}, {name}", *(f"{value:.2f}" for value in each)]
        for image, by_name in errors.items()
        for name, each in by_name.items()
    ]
    rows += [[f"ns a lookup, {name}", *(f"{value:.0f}" for value in each)] for name, each in times.items()]
    report.table(heads, rows)
    for image in errors:
        for stretch, ewa, other in zip(
            _STRETCHES, errors[image]["ewa"], errors[image]["trilinear"], strict=True
        ):
            if stretch >= 4:
                what = f"filters: EWA's error beside trilinear's, {image}, {stretch} : 1"
                report.at_most(what, ewa / other, 1 / 3)
    for stretch, ewa, other in zip(_STRETCHES, times["ewa"], times["trilinear"], strict=True):
        report.at_most(f"filters: EWA's time beside trilinear's, {stretch} : 1", ewa / other, 4)


def _images(rng: np.random.Generator, side: int) -> dict[str, npt.NDArray[np.uint8]]:
    """Return what fades with frequency, as pictures do, with hard edges and without."""
    frequencies = np.hypot(*np.meshgrid(np.fft.fftfreq(side), np.fft.fftfreq(side)))
    frequencies[0, 0] = 1.0
    pink = np.fft.ifft2(np.fft.fft2(rng.normal(size=(side, side))) / frequencies).real
    pink = (pink - pink.mean()) / pink.std()
    smooth = np.clip(128 + 50 * pink, 0, 255).astype(np.uint8)
    edges = np.where((10 * pink).astype(int) % 2 == 0, 30, 220).astype(np.uint8)
    return {"pink noise": smooth, "its contours, hard": edges}


def _surface(
    texels: npt.NDArray[np.uint8], stretch: float, width: float, angle: float, filter: str
) -> octex.Surface:
    """Return a triangle whose unit of length is width × (width · stretch) texels, turned in the image."""
    across = np.array([[1.0, 0.0], [0.0, stretch]]) * width
    turned = _rotation(angle) @ across @ _rotation(1.7 * angle + 1.0)
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    vertices = np.column_stack([4.0 * corners, np.zeros(3)])
    uv = 4.0 * corners @ turned.T / len(texels)
    return octex.Surface.from_arrays(vertices, [[0, 1, 2]], uv=uv, image=texels, filter=filter)


def _rotation(angle: float) -> Floats:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def _read(surface: octex.Surface, places: Floats, width: float) -> npt.NDArray[np.float32]:
    """Return values at places (n, 2) of the triangle."""
    x, y = places.T / 4.0
    triangles = np.zeros(len(places), np.int32)
    barycentric = np.stack([1.0 - x, x - y, y], axis=1)
    return surface.evaluate_all(triangles, barycentric, np.full(len(places), width, np.float32))


def _squared_errors(
    texels: npt.NDArray[np.uint8],
    stretch: float,
    width: float,
    angle: float,
    count: int,
    fine: int,
    rng: np.random.Generator,
) -> Floats:
    """Return each filter's mean squared error beside the mean of fine² reads in the footprint's square."""
    places = 0.5 + 3.0 * np.sort(rng.random((count, 2)), axis=1)[:, ::-1]
    steps = (np.arange(fine) + 0.5) / fine - 0.5
    square = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    reads = _read(
        _surface(texels, stretch, width, angle, "bilinear"), (places[:, None] + square).reshape(-1, 2), 0.0
    )
    truth = linear_to_srgb(reads.reshape(count, -1, 3).mean(axis=1))
    errors = []
    for name in _FILTERS:
        found = linear_to_srgb(_read(_surface(texels, stretch, width, angle, name), places, 1.0))
        errors.append(np.mean((255.0 * (found - truth)) ** 2))
    return np.array(errors)


def _times(setup: Setup, side: int) -> dict[str, list[float]]:
    """Return nanoseconds a lookup by filter and stretch, over all widths, points in rows."""
    across = 30 if setup.quick else 300
    texels = np.random.default_rng(1).integers(0, 256, (side, side, 3)).astype(np.uint8)
    grid = np.stack(np.meshgrid(np.arange(across), np.arange(across)), axis=-1).reshape(-1, 2) / across
    places = grid[grid[:, 0] >= grid[:, 1]] * 4.0
    times: dict[str, list[float]] = {name: [] for name in _FILTERS}
    for stretch in _STRETCHES:
        surfaces = {name: [_surface(texels, stretch, w, 0.5, name) for w in _WIDTHS] for name in _FILTERS}
        works = {
            name: lambda each=each: [_read(surface, places, 1.0) for surface in each]
            for name, each in surfaces.items()
        }
        for name, spent in clocked(setup, works, setup.core).items():
            times[name].append(spent.cpu / (len(_WIDTHS) * len(places)) * 1e9)
    return times


def materials(setup: Setup, report: Report) -> None:
    """All channels of a model beside its base colour alone."""
    depth = 6 if setup.quick else 10

    def convert(model: octex.Surface) -> octex.OctreeTexture:
        with ThreadPoolExecutor(1) as pool:
            return octex.convert(model, depth, fit=False, run=octex.Run(executor=pool))

    for folder in ("BoomBoxWithAxes", "Avocado"):
        path = setup.models / folder / f"{folder}.gltf" if setup.models else None
        if path is None or not path.is_file():
            report.note(f"materials: left out without --models: {folder}")
            continue
        surface = octex.load_surface(path)
        names = ", ".join(channel.name for channel in surface.channels)
        report.title(f"materials: {surface.name}, depth {depth}, one thread: {names}")
        color = surface.with_channels(["base_color"])
        work = {"base colour": partial(convert, color), "all channels": partial(convert, surface)}
        spent = clocked(setup, work, setup.core)
        for name, each in spent.items():
            report.line(name, each)
        ratio = spent["all channels"].cpu / spent["base colour"].cpu
        report.at_most(f"materials: all channels beside base colour, {folder}", ratio, 2.5)
