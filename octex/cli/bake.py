"""octex bake: an octree texture and its model in; the model with images, for other tools, out."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import octex
from octex.cli.addresses import check_texture, file_here, output_file, texture_file
from octex.cli.arguments import channel_names, edge_length, error_codes, length, real, whole_number
from octex.cli.common import Reporter, bytes_text, check_outputs, limited, run, tell
from octex.cli.models import open_sound
from octex.cli.parser import RUNNING, Command, Parser, option, words_given
from octex.cli.shape_options import SHAPE_OPTIONS, check_subdivision, shaped_model
from octex.errors import ArgumentError, ExitCode

if TYPE_CHECKING:
    from octex.baking.maps import Bits
    from octex.formats.images import ImageFormat

_OF_IMAGES = (
    *("--uv", "--texture-size", "--padding", "--channels", "--image-format", "--supersample"),
    *("--source", "--max-distance"),
)
_OF_VERTICES = ("--subdivide", "--max-error")
#: As formats.models.WRITTEN_ENDINGS, without an import; and those that have colours at vertices alone, and
#: those that state a unit.
_USD = (".usdz", ".usd", ".usda", ".usdc")
BAKED_ENDINGS = (".glb", ".gltf", ".obj", *_USD, ".3mf")
_ENDINGS = (*BAKED_ENDINGS, ".ply")
_ALWAYS_VERTICES = (".ply", ".3mf")
_WITH_UNIT = (*_USD, ".3mf")
#: How images are stored, and the bits of a number in their maps.
_IMAGES: dict[str, tuple[ImageFormat, Bits]] = {
    "png": ("png", 8), "webp": ("webp", 8), "jpeg": ("jpeg", 8), "jpeg-all": ("jpeg-all", 8),
    "png16": ("png", 16), "exr": ("exr", 32),
}  # fmt: skip
#: Images of more bytes than this are large.
_LARGE = 10_000_000
_UNITS = ("meter", "centimeter", "millimeter", "inch", "foot")

BAKE = Command(
    "Write a model with images, or vertex colours, of a texture, for other programs.",
    [
        option("TEXTURE", "an .octex file", type=texture_file),
        option(
            "MODEL",
            "the model of the texture; with --source, a simpler mesh of the same object",
            type=file_here,
        ),
        option("OUTPUT", f"NAME{', NAME'.join(_ENDINGS)}", type=output_file),
    ],
    [
        option(
            "--uv",
            "texture coordinates: auto (default) keeps the model's unless they overlap; keep; or atlas, "
            "new ones",
            choices=("auto", "keep", "atlas"),
        ),
        option(
            "--texture-size",
            "width and height of the images in texels (default: a power of two that keeps the leaves' "
            "detail, up to 8192)",
            metavar="N",
            type=whole_number,
        ),
        option(
            "--source",
            "the original model of the texture, where MODEL is simpler",
            metavar="MODEL",
            type=file_here,
        ),
        option(
            "--max-distance",
            "how far the surface of --source may be, in its units (default: any distance)",
            metavar="DISTANCE",
            type=length,
        ),
        option(
            "--padding",
            "texels around each chart (default 8; fewer if an atlas has little room)",
            metavar="N",
            type=whole_number,
        ),
        option(
            "--channels",
            "names of the channels to bake, like base_color,normal",
            metavar="NAMES",
            type=channel_names,
        ),
        option(
            "--image-format",
            "png (default); webp, smaller, not in USD; jpeg, lossy for colours; jpeg-all, lossy for all; "
            "png16, 16 bits; exr, floats, not in glTF",
            choices=tuple(_IMAGES),
        ),
        option(
            "--supersample",
            "average this many lookups along each side of a texel (default 1)",
            metavar="N",
            type=whole_number,
        ),
        option(
            "--vertex-colors",
            "write colours at the vertices instead of images; always so in .ply and .3mf",
            action="store_true",
        ),
        option(
            "--subdivide",
            "divide triangles until edges are no longer than SIZE; auto: until vertex colours are within "
            "--max-error (default: no division; for .3mf auto)",
            metavar="SIZE",
            type=edge_length,
        ),
        option(
            "--max-error",
            "largest error of vertex colours, in 1/255 (default 8)",
            metavar="CODES",
            type=error_codes,
        ),
        option(
            "--displace",
            "divide the model to the texture's cells and move it along its normals by this channel; for "
            "colours by their luminance",
            metavar="CHANNEL",
        ),
        option(
            "--scale",
            "distance that a channel value of 1 moves the surface, in its units",
            metavar="S",
            type=real,
        ),
        option(
            "--middle", "channel value that does not move the surface (default 0)", metavar="H", type=real
        ),
        option(
            "--unit",
            f"what a length of 1 means in .3mf and USD: {', '.join(_UNITS)} (default meter)",
            metavar="UNIT",
            choices=_UNITS,
        ),
        option(
            "--rest",
            "the undeformed model, with the same vertices and triangles",
            metavar="MODEL",
            type=file_here,
        ),
        *SHAPE_OPTIONS,
        *RUNNING,
    ],
    [
        "droid.octex droid.glb baked.glb",
        "droid.octex droid.glb web.glb --texture-size 1024 --image-format webp",
    ],
)


def main(arguments: Sequence[str] | None, program: str) -> int:
    """Run octex bake, and return its exit code (octex.errors.ExitCode)."""
    return run(program, lambda: bake(Parser(program, BAKE).parsed(arguments), program))


def baking(options: argparse.Namespace, program: str) -> argparse.Namespace:
    """Return the options of octex bake that those of octree-convert --mesh stand for."""
    files = options.INPUT, options.mesh, options.OUTPUT
    made = Parser(program, BAKE).parse_args([str(each) for each in files])
    shape = "rest", "pose", "subdiv_levels", "subdiv_rest"
    for word in (*shape, "channels", "force", "threads", "quiet", "json"):
        setattr(made, word, getattr(options, word))
    return made


def bake(options: argparse.Namespace, program: str) -> int:
    """Bake, as the options of octex bake say; return the exit code."""
    began = time.perf_counter()
    check_texture(options.TEXTURE)
    ending = options.OUTPUT.suffix.lower()
    options.vertex_colors |= ending in _ALWAYS_VERTICES
    work, others = ("vertex colours", _OF_IMAGES) if options.vertex_colors else ("images", _OF_VERTICES)
    for word in words_given(options):
        if word in others:
            raise ArgumentError(f"{word} has no meaning with {work}; see {program} --help")
    check_subdivision(options)
    for word in ("scale", "middle"):
        if getattr(options, word) is not None and options.displace is None:
            raise ArgumentError(f"--{word} has no meaning without --displace")
    if options.displace is not None and options.scale is None:
        raise ArgumentError(f"--displace {options.displace} needs --scale: what 1 there moves the model by")
    if options.unit is not None and ending not in _WITH_UNIT:
        raise ArgumentError(f"--unit has no meaning for {options.OUTPUT}: such files state none")
    inputs = options.TEXTURE, options.MODEL, options.rest, options.source
    check_outputs([(options.OUTPUT, _ENDINGS, "OUTPUT")], inputs, force=options.force)
    images, bits = _IMAGES[options.image_format or "png"]
    if images == "exr" and ending in (".glb", ".gltf"):
        raise ArgumentError(f"{options.OUTPUT}: glTF holds no exr images; write a .obj or .usdz, or png16")
    from octex.formats.models import check_extra

    check_extra(options.OUTPUT)
    with limited(options.threads), Reporter(program, options.quiet) as progress:
        with progress.stage("read"):
            texture = open_sound(options.TEXTURE)
            surface = shaped_model(options.MODEL, options, normals=True)
            source = None if options.source is None else octex.load_surface(options.source)
        if options.displace is not None:
            with progress.stage("displace"):
                surface = octex.displace(
                    surface, texture, options.displace, options.scale, middle=options.middle or 0.0
                )
        if options.vertex_colors:
            with progress.stage("divide"):
                error = 8.0 if options.max_error is None else options.max_error
                if ending == ".3mf" and options.subdivide is None:
                    options.subdivide = "auto"
                baked = octex.bake_vertices(texture, surface, subdivide=options.subdivide, max_error=error)
        else:
            baked = octex.bake(
                texture,
                surface,
                source=source,
                max_distance=options.max_distance,
                uv=options.uv or "auto",
                texture_size=options.texture_size,
                padding=options.padding,
                channels=options.channels,
                bits=bits,
                supersample=1 if options.supersample is None else options.supersample,
                progress=progress,
            )
        with progress.stage("write"):
            written = octex.write_model(baked, options.OUTPUT, images=images, unit=options.unit or "meter")
    size = max(_sizes(baked), default=0)
    made: dict[str, Any] = {
        "output": str(options.OUTPUT),
        "channels": [form.name for form in baked.channels],
        "triangles": len(baked.triangles),
        "vertices": len(baked.vertices),
        "texture_size": size,
        "bytes": sum(path.stat().st_size for path in written.files),
        "image_bytes": written.image_bytes,
        "seconds": round(time.perf_counter() - began, 3),
    }
    where = f"in maps of {size} × {size}" if size else f"at {len(baked.vertices):,} vertices"
    what = f"{', '.join(made['channels'])} {where}, {bytes_text(made['bytes'])}"
    lines = [f"{options.OUTPUT}: {what}, {made['seconds']:.1f} s"]
    if images == "png" and written.image_bytes > _LARGE:
        webp = "" if ending in _USD else "webp makes them smaller without loss, "
        taken = f"its images take {bytes_text(written.image_bytes)}"
        lines.append(f"{taken}: --image-format {webp}jpeg makes colours far smaller with some")
    tell(options, made, *lines)
    return ExitCode.DONE


def _sizes(baked: octex.Surface) -> Iterator[int]:
    """Yield the widths of a surface's images."""
    from octex.formats.images import materials_of

    for material in materials_of(baked).materials:
        for given in material.inputs.values():
            if given.texture is not None:
                yield given.texture.texels.shape[1]
