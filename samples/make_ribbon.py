"""Make a twisted ribbon, red on one side and green on the other, thin enough for both to share a cell."""

import numpy as np

import octex


def ribbon(thickness: float = 0.03) -> octex.Surface:
    """Return two sheets of opposite facings, striped, 2 units long and ``thickness`` apart."""
    t, s = (grid.ravel() for grid in np.meshgrid(np.linspace(0, 1, 161), np.linspace(-1, 1, 9)))
    turn, none = 2.6 * np.sin(4.5 * t + 0.3), np.zeros_like(t)
    across = np.column_stack([none, np.cos(turn), np.sin(turn)])
    normals = np.column_stack([none, -np.sin(turn), np.cos(turn)])
    middle = np.column_stack([2 * t - 1, 0.2 * np.sin(6 * t), none]) + 0.33 * across * s[:, None]
    grid = np.arange(9 * 161).reshape(9, 161)
    a, b, c, d = (part.ravel() for part in (grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]))
    front = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    stripes = [[(214, 40, 40), (40, 160, 70)], [(250, 190, 170), (8, 60, 34)]]
    image = np.tile(np.array(stripes, np.uint8), (64, 1, 1)).repeat(8, axis=1)
    uv = np.concatenate([np.column_stack([none + u, t]) for u in (0.25, 0.75)])
    vertices = np.concatenate([middle + thickness / 2 * normals, middle - thickness / 2 * normals])
    triangles = np.concatenate([front, front[:, ::-1] + len(middle)])
    return octex.Surface.from_arrays(vertices, triangles, uv=uv, image=image, name="ribbon")
