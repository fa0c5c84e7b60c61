"""Strokes and other commands on a small ball, as pages send them and as users of the library paint them."""

from __future__ import annotations

import json
import zlib
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

import octex
from octex.session.painting import Session
from octex.source.surface import Surface
from octex.texture import OctreeTexture
from tests.make.painted import ball

PAGE = "01234567-89ab-cdef"
SIZE = 48, 32
OCTETS = "application/octet-stream"


@cache
def canvas() -> tuple[OctreeTexture, Surface]:
    surface = ball(12)
    return octex.convert(surface, depth=5), surface


@cache
def camera() -> octex.Camera:
    return octex.Camera.fitted(ball(12).vertices, (0.3, 0.2, 1.0), size=SIZE)


def camera_sent(seen_by: octex.Camera) -> dict[str, Any]:
    pose, K = seen_by.world_to_camera.tolist(), seen_by.K.tolist()
    return {"width": seen_by.width, "height": seen_by.height, "K": K, "pose": pose}


def stroke(number: int, page: str = PAGE, **given: Any) -> bytes:
    """Return a round stroke on the ball."""
    content = given.pop("content", None)
    color = [200, 10 * (number % 20), 30]
    usual = {"name": f"Brush {number}", "camera": camera_sent(camera()), "box": [10, 4, 40, 28]}
    usual |= {"color": color, "opacity": 0.8, "maxAngle": 85}
    line = plain("stroke", number, page, **usual | given)
    return line + (deflated(disc(number).tobytes()) if content is None else content)


def plain(kind: str, number: int, page: str = PAGE, **given: Any) -> bytes:
    """Return a command without content."""
    return json.dumps({"page": page, "number": number, "kind": kind, **given}).encode() + b"\n"


def without_color(body: bytes) -> bytes:
    line, _, content = body.partition(b"\n")
    fields = {name: value for name, value in json.loads(line).items() if name != "color"}
    return json.dumps(fields).encode() + b"\n" + content


def deflated(content: bytes) -> bytes:
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    return packer.compress(content) + packer.flush()


def disc(number: int) -> npt.NDArray[np.uint8]:
    """Return what a stroke covers of its box."""
    y, x = np.mgrid[:24, :30]
    away = np.hypot(x - 8 - 3 * (number % 4), y - 12)
    return np.clip(255 * (6.5 - away), 0, 255).astype(np.uint8)


def image_sent(number: int, color: Any = None) -> npt.NDArray[np.uint8]:
    """Return the image of a stroke, by default in its own colour."""
    image = np.zeros((SIZE[1], SIZE[0], 4), np.uint8)
    image[..., :3] = (200, 10 * (number % 20), 30) if color is None else color
    image[4:28, 10:40, 3] = disc(number)
    return image


def painted(painter: octex.Painter, number: int, blend: str = "over") -> None:
    """Paint a stroke as a user of the library does."""
    image = octex.Projection(image_sent(number), camera(), opacity=0.8, blend=blend)
    painter.paint(image, max_angle=85)


def take(session: Session, *bodies: bytes) -> None:
    """Send commands, and wait until they are done."""
    for body in bodies:
        session.take(body)
    session.wait()


def ones(points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return np.ones(len(points))


def assert_mirrored(
    session: Session, axis: int, count: int, least: int, most_apart: float, beyond: float
) -> None:
    """Check that paint on the ball is its own mirror image, and on both sides."""
    points = np.random.default_rng(0).normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    image = points.copy()
    image[:, axis] *= -1

    def is_painted(points: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
        apart = session.shown.texture.sample(points) - canvas()[0].sample(points)
        return np.asarray(np.abs(apart).max(axis=1) > 0.1)

    here, there = is_painted(points), is_painted(image)
    assert least < here.sum() < 2000
    assert (here != there).sum() < most_apart * here.sum()  # cells are not where a mirror has them
    assert here[points[:, axis] > beyond].any()
    assert here[points[:, axis] < -beyond].any()
