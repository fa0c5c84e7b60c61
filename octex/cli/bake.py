"""octex bake: writes a model with images for other programs, from an octree texture and its model."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import octex
from octex.cli.common import Reporter, check_outputs, report_file
from octex.cli.inputs import kind_of, open_texture, refuse, repair_facts, shaped_model
from octex.cli.options import RUNNING, SHAPE
from octex.cli.parser import Options, arguments
from octex.cli.values import BAKED_ENDINGS, PTEX_ENDING, USD_ENDINGS
from octex.errors import ArgumentError
from octex.files import bytes_text

if TYPE_CHECKING:
    from octex.baking.maps import Bits
    from octex.formats.images import ImageFormat

_OF_IMAGES = {"--uv", "--texture-size", "--padding", "--channels", "--image-format", "--supersample"}
_OF_IMAGES |= {"--triangles", "--original", "--max-distance"}
_OF_VERTICES = "--max-edge", "--vertex-error"
_GLTF = ".glb", ".gltf"
#: Image formats by option value, and the bits of a component.
_IMAGES: dict[str, tuple[ImageFormat, Bits]] = {
    "png": ("png", 8), "webp": ("webp", 8), "jpeg": ("jpeg", 8), "jpeg-all": ("jpeg-all", 8),
    "png16": ("png", 16), "exr": ("exr", 32),
}  # fmt: skip
#: Images of more bytes than this are large; a note then suggests another format.
_LARGE = 10_000_000


def bake(options: Options, program: str) -> int:
    """Run octex bake."""
    ending = options.OUTPUT.suffix.lower()
    inputs = options.TEXTURE, options.MODEL, options.rest, options.original
    check_outputs([(options.OUTPUT, BAKED_ENDINGS, "OUTPUT")], inputs, force=options.force)
    if ending == PTEX_ENDING:
        if options.TEXTURE is None:
            raise ArgumentError(f"{options.OUTPUT}: needs a texture; octex convert makes one of the model")
        return _write_ptex(options, program)
    at_vertices = options.vertex_colors or ending in (".ply", ".3mf")
    if at_vertices:
        refuse(options, _OF_IMAGES, "cannot be used with vertex colours")
        if options.max_edge not in (None, "auto"):
            refuse(options, ["--vertex-error"], "needs --max-edge auto")
    else:
        refuse(options, _OF_VERTICES, "is for vertex colours; add --vertex-colors")
    if ending not in (*USD_ENDINGS, ".3mf"):
        refuse(options, ["--unit"], f"has no effect on {options.OUTPUT}: the format stores no unit")
    if ending not in _GLTF:
        refuse(options, ["--octree"], f"has no effect on {options.OUTPUT}: only .glb and .gltf carry it")
    images, bits = _IMAGES[options.image_format]
    if options.triangles is not None:
        refuse(options, ["--original", "--displace"], "cannot be used with --triangles")
        if options.uv == "keep":
            raise ArgumentError("--uv keep cannot be used with --triangles: the mesh gets new UVs")
        from octex.baking.simplify import check_simplifier

        check_simplifier()
    from octex.baking.finish import own_texture
    from octex.formats.models import check_written, materials_of
    from octex.gltf import Document

    check_written(options.OUTPUT, images)
    with Reporter(program, options.quiet) as progress:
        with progress.stage("read"):
            texture = None if options.TEXTURE is None else open_texture(options.TEXTURE)
            cell = None if texture is None else texture.placement.size / 2.0**texture.tree.max_depth
            surface = shaped_model(options.MODEL, options, cell, normals=True)
            facts, lines = repair_facts(surface)
            original = None if options.original is None else octex.load_surface(options.original)
        if texture is None:
            path, source = options.original or options.MODEL, original or surface
            model = path if kind_of(path) == "voxels" else source
            texture = own_texture(model, source, None, options.texture_size, octex.Run(progress=progress))
        if options.triangles is not None and len(surface.triangles) > options.triangles:
            with progress.stage("simplify"):
                original, surface = surface, octex.simplify(surface, options.triangles)
        elif options.triangles is not None:
            lines.append(f"the model has no more than {options.triangles:,} triangles: all stay")
        if options.displace is not None:
            channel, height, middle = options.displace
            with progress.stage("displace"):
                surface = octex.displace(texture, surface, channel, height, middle=middle)
        if at_vertices:
            with progress.stage("divide"):
                error = 8.0 if options.vertex_error is None else options.vertex_error
                is_divided = ending == ".3mf" or options.vertex_error is not None
                edge: Any = options.max_edge or ("auto" if is_divided else None)
                baked = octex.bake_vertices(texture, surface, subdivide=edge, max_error=error)
        else:
            baked = octex.bake(
                texture,
                surface,
                source=original,
                uv=options.uv or ("auto" if options.triangles is None else "atlas"),
                bits=bits,
                progress=progress,
                **arguments(options, "texture_size", "padding", "channels", "supersample", "max_distance"),
            )
        with progress.stage("write"):
            extras = {"unit": options.unit, "octree": texture if options.octree else None}
            written = octex.write_model(baked, options.OUTPUT, images=images, **extras)
    materials = materials_of(baked).materials
    textures = [(name, each.texture) for material in materials for name, each in material.inputs.items()]
    size = max((texture.texels.shape[1] for _, texture in textures if texture is not None), default=0)
    names = [form.name for form in baked.channels]
    facts |= {
        "channels": names,
        "triangles": len(baked.triangles),
        "vertices": len(baked.vertices),
        "texture_size": size,
        "bytes": sum(path.stat().st_size for path in written.files),
        "image_bytes": written.image_bytes,
    }
    description = [f"{', '.join(names)} at {len(baked.vertices):,} vertices"]
    if not at_vertices:
        mapped = dict.fromkeys(name for name, texture in textures if texture is not None)
        constant = [name for name in names if name not in mapped]
        description = [f"{', '.join(constant)} constant"] if constant else []
        description += [f"{', '.join(mapped)} in maps of {size} × {size}"] if mapped else []
    if options.MODEL.suffix.lower() in _GLTF and Document(options.MODEL).json.get("animations"):
        hint = "" if at_vertices else "; --uv keep bakes images for the original model"
        lines.append(f"its animations are not written{hint}")
    if images == "png" and written.image_bytes > _LARGE:
        webp = "" if ending in USD_ENDINGS else "webp is smaller and lossless, "
        size_text = f"its images take {bytes_text(written.image_bytes)}"
        lines.append(f"{size_text}: --image-format {webp}jpeg is far smaller and lossy")
    return report_file(options, "; ".join(description), facts, *lines)


def _write_ptex(options: Options, program: str) -> int:
    others = set(options.words) - {"--channels", *SHAPE, *RUNNING}
    refuse(options, others, f"cannot be used for {options.OUTPUT}")
    with Reporter(program, options.quiet) as progress:
        with progress.stage("read"):
            texture = open_texture(options.TEXTURE)
            surface = shaped_model(options.MODEL, options, channels=["alpha"], sources={"alpha": 1.0})
        octex.write_ptex(texture, surface, options.OUTPUT, channels=options.channels, progress=progress)
    from octex.formats.ptex.reader import PtexFile

    with PtexFile(options.OUTPUT) as file:
        facts = {"faces": file.n_faces, "texels": int(file.faces.counts.sum())}
    return report_file(options, f"{facts['texels']:,} texels on {facts['faces']:,} faces", facts)
