"""Random steps that paint: images, layers, fills, sessions."""

import re

import numpy as np

from octex.painting.image import BLENDS
from tests.properties import edit_claims as claims
from tests.properties.edit_models import MESHES, RAMP
from tests.properties.edit_run import Step, call, color_of, extent_of, one_of, place_on, some


def projection(random, blend=None):
    width, height = (int(each) for each in random.integers(8, 40, 2))
    seed = int(random.integers(1000))
    image = call("random_image", seed, width, height, random.random() < 0.5)
    options = {}
    how = random.random()
    if how < 0.2:
        image = call("stroke", seed, width, height)
    elif how < 0.4:
        options["since"] = image
        image = call("drawn_on", image, seed)
    if random.random() < 0.5:
        options["opacity"] = one_of(random, (0.5, 0.25, 0.9))
    blend = blend or one_of(random, (*BLENDS, "over", "over"))
    if blend != "over":
        options["blend"] = repr(blend)
    seen = call("camera", "surface", int(random.integers(1000)), width, height)
    return call("octex.Projection", image, seen, **options)


def overshoots(images):
    """Whether any image is no ramp."""
    seeds = re.findall(r"image\((\d+)", images)
    return "stroke(" in images or "drawn_on(" in images or any(int(seed) % 3 != RAMP for seed in seeds)


def paint_options(random, run):
    depth = run.texture.tree.max_depth
    options = {"max_depth": int(np.clip(depth + random.integers(-1, 3), 1, 6))}
    if random.random() < 0.5:
        options["fit"] = False
    if random.random() < 0.2:
        options["edge_feather"] = some(random, 0.5, 4)
    if random.random() < 0.2:
        options["back_faces"] = True
    if random.random() < 0.15:
        options["hidden"] = True
    if random.random() < 0.15:
        options["region"] = f"np.arange({len(run.surface.triangles)}) % 3 > 0"
    if random.random() < 0.3:
        options["max_angle"] = one_of(random, (90.0, 30.0, 180.0))
        options["run"] = "octex.Run(memory=1)"  # byte: images lie in files meanwhile
    paintable = [name for name, each in run.texture.channels.items() if name not in ("alpha", "normal")]
    name = one_of(random, paintable)
    if name != "base_color":
        options["channel"] = repr(name)
    return options


def near(region):
    """Nothing moves but what is within a cell of paint: in the field two, with normals also beside leaves."""

    def claim(run, before, after):
        where = region(run, before)
        claims.assert_far_cells_stay(before, after, where, 1.01, run.surface)
        claims.assert_far_field_stays(before, after, run.surface, where, 2.01, len(run.steps))

    return claim


def draw_paint(random, run):
    options = paint_options(random, run)
    blend = one_of(random, (*BLENDS, "over"))
    shots = [projection(random, blend) for _ in range(int(random.integers(1, 4)))]
    if len(shots) > 1 and "hidden" not in options and random.random() < 0.3:
        options["balance"] = one_of(random, ("'gain'", "'full'"))
    images = shots[0] if len(shots) == 1 else f"[{', '.join(shots)}]"
    line = call("texture = octex.paint", "texture", "surface", "images", **options)
    code = call("octex.project", "surface", "images", like="texture", **options)

    def painted(run, before):
        layer = eval(code, {**run.names, "texture": before})
        if "balance" in options:
            most = max(claims.largest(layer, name) for name in layer.channels)
            assert most < claims.LARGEST_GAIN, f"images that were made to agree are as bright as {most}"
        return claims.painted_boxes(layer)

    fits = "fit" not in options
    lines = f"images = {images}", line
    return Step(lines, near(painted), fits=fits, leaves_range=True, is_exact=True, layers=(code,))


def draw_layer(random, run):
    options = paint_options(random, run)
    shots = [projection(random, "over") for _ in range(int(random.integers(1, 3)))]
    images = shots[0] if len(shots) == 1 else f"[{', '.join(shots)}]"
    line = call("layer = octex.project", "surface", images, like="texture", **options)
    return merged(random, (line,), fits="fit" not in options)


def merged(random, lines, fits):
    """Merge the layer that there is."""
    how = {"opacity": one_of(random, (1.0, 0.5, 0.3)), "blend": repr(one_of(random, BLENDS))}
    line = call("texture = octex.merge", "texture", "layer", "surface", **how)
    claim = near(lambda run, _before: claims.painted_boxes(run.names["layer"]))
    return Step((*lines, line), claim, fits=fits, leaves_range=True, is_exact=True, layers=("layer",))


def draw_again(random, run):
    """Merge a layer once more."""
    layer = run.names.get("layer")
    if layer is None or not set(layer.channels) - {"alpha"} <= set(run.texture.channels):
        return draw_layer(random, run)
    return merged(random, (), fits=True)


def draw_fill(random, run):
    texture, size = run.texture, extent_of(run)
    depth = int(np.clip(texture.tree.max_depth + random.integers(-1, 3), 1, 6))
    edge = texture.placement.size / 2**depth
    names = [name for name in texture.channels if name != "alpha"]
    name = one_of(random, names)
    components = texture.channels[name].format.components
    color = (0.0, 0.0, 1.0) if name == "normal" else color_of(random, components)
    blend = one_of(random, (*BLENDS, "over", "erase"))
    opacity = one_of(random, (1.0, 1.0, 0.5, 0.2))
    options = {
        "channel": None if name == "base_color" else repr(name),
        "opacity": None if opacity == 1.0 else opacity,
        "blend": None if blend == "over" else repr(blend),
        "max_depth": depth,
    }
    kind = one_of(random, ("sphere", "sphere", "box", "triangles", "function"))
    soft = one_of(random, (0.0, 0.0, round(0.1 * size, 3)))
    center = np.array(place_on(random, run))
    radius = round(size * one_of(random, (0.05, 0.15, 0.4, 2.0)), 3)
    if kind == "sphere":
        region = call("octex.Sphere", tuple(center.tolist()), radius, soft=soft or None)
        where = claims.Ball(tuple(center.tolist()), radius, edge)
    elif kind == "box":
        low, high = ((center + sign * radius).round(3) for sign in (-1, 1))
        region = call("octex.Box", tuple(low.tolist()), tuple(high.tolist()), soft=soft or None)
        where = claims.Boxes(low[None], high[None], np.array([edge]), 1.0)
    elif kind == "triangles":
        count = len(run.surface.triangles)
        chosen = sorted({int(each) for each in random.integers(0, count, 2)})
        corners = run.surface.placed_in(texture).rest[run.surface.triangles[chosen]]
        region = str(chosen)
        where = claims.Boxes(corners.min(axis=1), corners.max(axis=1), np.full(len(chosen), edge), 1.0)
    else:
        axis, width = int(random.integers(3)), round(0.1 * size, 3)
        region = call("beyond", axis, round(float(center[axis]), 3), width)
        low, high = np.full((2, 3), [[-1e9], [1e9]])
        low[axis] = center[axis] - width
        where = claims.Boxes(low[None], high[None], np.array([edge]), 1.0)
    line = call("texture = octex.fill", "texture", "surface", region, color, **options)

    def claim(run, before, after):
        if run.surface.placed_in(before) is not run.surface:
            return  # parts were moved, the region is where they were
        near(lambda _run, _before: where)(run, before, after)
        claims.assert_other_channels_stay(before, after, run.surface, name, len(run.steps))
        if kind in ("sphere", "box") and not soft:
            assert_filled(run, before, after, where, name, color, blend, opacity)

    free = blend in ("add", "screen") or name == "normal"
    return Step((line,), claim, leaves_range=free, is_exact=True)


def assert_filled(run, before, after, where, name, color, blend, opacity):
    """Deep inside a region the field is what blending says of it as it was."""
    texture_name = "alpha" if blend == "erase" else name
    if blend == "add" and after.channels[name].format.dtype.startswith("u"):
        return  # which clamp
    if claims.adds_leaves(before, after):
        return  # where there was nothing paint is opaque
    has_alpha = "alpha" in before.channels
    if has_alpha and blend != "erase" and (opacity < 1 or blend in ("multiply", "screen", "add")):
        return  # colours weigh by alphas that were other ones
    samples = run.surface.placed_in(before).scatter(300, len(run.steps))
    is_stored = before.contains(samples.rest)
    points, facing = samples.rest[is_stored], samples.normals[is_stored]
    edge = where.edge if isinstance(where, claims.Ball) else where.edges[0]
    # A node that keeps a coefficient keeps the old one where unpainted surface is in or beside it. Cells off
    # the surface are refined from it, level by level to half a cell beyond, and reach as far as the spline.
    kept = claims.kept_edge(after)
    is_deep = where.depths(points) > max(4.0 * edge, 3.0 * kept + 0.5 * edge if kept else 0.0)
    points, facing = points[is_deep], facing[is_deep]
    if not len(points):
        return
    form = after.channels[texture_name].format
    if texture_name in before.channels:
        was = before.sample(points, texture_name, normalize=False).astype(float)
    else:
        was = np.ones((len(points), 1))
    paint = np.broadcast_to(np.asarray(color, float), (len(points), len(color)))
    paint = {
        "multiply": lambda: was * paint,
        "screen": lambda: 1 - (1 - was) * (1 - paint),
        "erase": lambda: np.zeros_like(was),
    }.get(blend, lambda: paint)()
    part = 1.0 if blend == "replace" else opacity
    wanted = was + part * paint if blend == "add" else was + part * (paint - was)
    slack = 1.5 * claims.code_width(form, claims.largest(after, texture_name)) + 2e-5
    for normals in (None, facing) if blend in ("over", "replace") and part == 1.0 else (None,):
        found = after.sample(points, texture_name, normals=normals, normalize=False)
        apart = np.abs(found - wanted).max(axis=1)
        worst = int(apart.argmax())
        assert apart[worst] <= slack, (
            f"inside the region {texture_name} with{'out' if normals is None else ''} normals at "
            f"{points[worst].tolist()} was {was[worst].tolist()}, is {found[worst].tolist()}, should be "
            f"{wanted[worst].tolist()}"
        )


def draw_fill_all(random, run):
    """Paint one colour over everything."""
    texture = run.texture
    depth = int(np.clip(texture.tree.max_depth + random.integers(-1, 2), 1, 6))
    name = one_of(random, [each for each in texture.channels if each not in ("alpha", "normal")])
    color = color_of(random, texture.channels[name].format.components)
    options = {
        "channel": None if name == "base_color" else repr(name),
        "blend": one_of(random, (None, "'replace'")),
        "max_depth": one_of(random, (None, depth)),
    }
    region = "np.ones(len(surface.triangles), bool)"
    line = call("texture = octex.fill", "texture", "surface", region, color, **options)

    def claim(run, before, after):
        claims.assert_other_channels_stay(before, after, run.surface, name, len(run.steps))
        # What a resize has made off the surface, where no paint is, counts in averages. What others have left
        # of it is not told from surface.
        script = "\n".join(run.script())
        is_divided = "octex.resize" in script
        if is_divided and any(f"octex.{each}" in script for each in ("crop", "mix", "combine")):
            return
        claims.assert_one_color(after, run.surface, name, color, len(run.steps), averages=not is_divided)

    return Step((line,), claim, is_exact=True)


def draw_session(random, run):
    """Paint in a session, forth and back: textures that it gives stay; it ends as a single call does.

    Images may be of another pose.
    """
    step, other = one_of(random, (draw_paint, draw_fill))(random, run), draw_fill(random, run).lines[-1]
    *first, single = (line.replace(", run=octex.Run(memory=1)", "") for line in step.lines)
    painted, passing = (
        re.sub(r"^texture = octex\.(\w+)\(texture, surface, ", r"painter.\1(", line)
        for line in (single, other)
    )
    stretches = [some(random, 0.6, 1.5) for _ in range(3)]
    is_posed = painted.startswith("painter.paint") and random.random() < 0.5
    if is_posed:
        painted = f"{painted[:-1]}, pose=posed)"
        single = single.replace("(texture, surface, ", "(texture, posed, ")
    passing += " and painter.undo()"  # what paints nothing is no stroke
    lines = (
        *first,
        f"posed = surface.with_pose(surface.vertices * {stretches})",
        "painter = octex.Painter(texture, surface)",
        *(passing, f"changes = {painted}", "held = painter.texture()", passing),
        *("changes and painter.undo()", "undone = painter.texture()", "changes and painter.redo()"),
        *(passing, "texture = painter.texture()"),
    )

    def claim(run, before, after):
        names = {**run.names, "texture": before}
        exec(single, names)
        for texture in after, run.names["held"]:
            assert claims.digest(texture) == claims.digest(names["texture"]), "a session ends otherwise"
        assert claims.digest(run.names["undone"]) == claims.digest(before), "a session undoes otherwise"
        if step.claim is not None and not is_posed:
            step.claim(run, before, after)

    seen = "(posed, " if is_posed else "(surface, "
    return step._replace(
        lines=lines, claim=claim, layers=tuple(code.replace("(surface, ", seen) for code in step.layers)
    )


def draw_layers(random, run):
    """Paint in two layers; replace both, hide one, undo and redo all: each brings back what was."""
    steps = draw_fill(random, run), draw_paint(random, run)
    lines = []
    for step, name in zip(steps, ("low", "high"), strict=True):
        *first, single = (line.replace(", run=octex.Run(memory=1)", "") for line in step.lines)
        blend, opacity = one_of(random, ("over", "multiply", "screen")), one_of(random, (1.0, 0.6))
        lines += [*first, f"{name} = layers.add_layer(blend={blend!r}, opacity={opacity}).number"]
        lines += [re.sub(r"^texture = octex\.(\w+)\(texture, surface, ", r"layers.\1(", single)]
        lines += [f"with_{name} = layers.texture()"]
    lines.insert(0, "layers = octex.Layers(texture, surface)")
    lines += ["layers.replace(with_low)", "replaced = layers.texture()", "layers.undo()"]
    lines += ["layers.change_layer(high, is_visible=False)", "layers.change_layer(high, is_visible=True)"]
    lines += ["again = layers.texture()", "count = len(layers.strokes)"]
    lines += ["for _ in range(count): layers.undo()", "undone = layers.texture()"]
    lines += ["for _ in range(count): layers.redo()", "texture = layers.texture()"]

    def claim(run, before, after):
        names = run.names
        assert claims.digest(names["undone"]) == claims.digest(before), "layers undo otherwise"
        assert claims.digest(names["replaced"]) == claims.digest(names["with_low"]), (
            "layers replace otherwise"
        )
        for each in after, names["again"]:
            assert claims.digest(each) == claims.digest(names["with_high"]), "layers are shown otherwise"

    return Step(tuple(lines), claim, fits=True, leaves_range=True)


def first_steps(random, run, small):
    kind = one_of(random, ("triangle", "flat", "planes") if small else MESHES)
    shape = int(random.integers(20))
    dtype = one_of(random, run.dtypes)
    depth = int(random.integers(2, 4 if small else 6))
    names = ["base_color"]
    if random.random() < 0.5:
        names.append("alpha")
    if random.random() < 0.3:
        names.append("roughness")
    if random.random() < 0.15:
        names.append("normal")
    surface = call("surface = waved", repr(kind), shape, names, int(random.integers(100)))
    fit = random.random() < 0.4
    options = {"dtype": repr(dtype), "fit": None if fit else False}
    how = random.random()
    if how < 0.15 and not small:
        options["max_error"] = one_of(random, (1, 4, 20))
    elif how < 0.3 and not small:
        options["detail"] = call("lambda points: 1 + points[:, 0] * 3 % 1 *", depth - 1)
    if kind == "overlapping" and random.random() < 0.5:
        options["separate"] = 1.0
    start = random.random()
    if start < 0.12 and not small:
        half = "surface.part(range(len(surface.triangles) // 2))"
        source = f"octex.Transfer({half}, distance={some(random, 0.05, 0.5)})"
        if "alpha" in names:  # the other model's own
            source += ".sources"
        else:
            source = f"{{'base_color': {source}}}"
        options["sources"] = source
        if kind == "triangle":
            del options["sources"]
    elif start < 0.2 and not small:
        points = f"cloud(surface, {shape}, {shape % 2 > 0})"
        line = call("texture = octex.convert", points, depth, dtype=repr(dtype))
        return [Step((surface, line))]
    elif start < 0.3 and not small:
        place = call("octex.Sphere", "surface.rest[0]", some(random, 0.2, 1.0))
        line = call("texture = octex.fill", "None", "surface", place, color_of(random, 3), max_depth=depth)
        return [Step((surface, line))]
    elif start < 0.36 and not small:
        fit = random.random() < 0.5
        shot = projection(random)
        line = call("texture = octex.paint", "None", "surface", shot, max_depth=depth, fit=fit)
        return [Step((surface, line), fits=fit or overshoots(shot))]
    line = call("texture = octex.convert", "surface", depth, **options)
    return [Step((surface, line), fits=fit, has_gaps="sources" in options)]
