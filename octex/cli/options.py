"""The commands of octex: one table of all options, and the files and options that each command takes."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

from octex.cli import values as v
from octex.cli.parser import Command, File, Option
from octex.files import size_of

DEFAULT_CHANNEL = "base_color"  # the channel to paint

#: Every option as help shows it; its description follows after several spaces.
_TABLE = """
--depth N             finest level: cells are 1/2^N of the model's longest side (default 10)
--cell SIZE           width of the finest cells in the model's units, instead of --depth
--max-error N         merge cells as long as no value changes by more than N/255 (try 2)
--detail CHANNEL      coarser cells where this channel is below 1; stretch: by the pose's stretch
--no-fit              store plain averages; lookups are less sharp
--dtype TYPE          stored type: uint8, uint16, float16, float32; or by channel: normal=uint16
--channels NAMES      names of the channels, like base_color,normal (default: all)
--memory SIZE         limit of memory, like 2GB; the rest goes to files next to OUTPUT

--rest MESH           the undeformed model, with the same vertices and triangles
--pose NAME@SECONDS   pose of an animated glTF model, like Run@0.5
--repair              remove triangles without area, duplicates and inner ones; close cracks narrower
                      than a cell
--subdiv N[,limit]    subdivide a control cage N times; limit: rest positions on the limit surface
--also MODEL          another model that shares the texture; may be repeated
--grid BOX,EDGE       for a function: its box and the triangles' edges, x0,y0,z0,x1,y1,z1,EDGE
--separate CELLS      move parts apart that are closer than this many cells (try 3)
--parts               write a folder with a texture for each part
--margin SIZE         smallest allowed distance between parts, in the model's units (default 0)

--source CHANNEL=X    image, .ptx, FILE.py:FUNCTION, number(s) or #rrggbb for a channel; repeatable
--project KIND        place images of --source without UVs: planar, box, cylindrical or spherical, like
                      box:size=0.5:axis=z:center=0,0,0
--transfer FILE       take colours from the nearest surface of a model, from points, or a .ptx
--within D[,DEGREES]  no cells where --transfer is farther than D, or its normal differs by more than
                      DEGREES; mean:R: the mean of the points within R
--filter NAME         filter of images: nearest, bilinear, bicubic, trilinear or ewa (default)

--crop BOX            keep only cells that meet the box x0,y0,z0,x1,y1,z1, in rest positions
--combine FILE        lay another texture with the same root cell over it
--mix FILE=AMOUNT     mix in AMOUNT (0 to 1) of another texture
--blur WIDTH          blur over the surface by this width, in the model's units
--levels LOW,HIGH     stretch base colours from LOW,HIGH to 0,1; a third number is the gamma
--loss N              for NAME.octz, lossy: let stored integers change by up to N

--camera FILE[#NAME]  cameras: camera.json, transforms.json, COLMAP folder … (octex help cameras)
--unwrap X,Y,Z,R      instead of a camera: a disc laid flat; X,Y,Z,R:conformal:up=X,Y,Z
--mask PNG            white = paint: one, or one per IMAGE, 'masks/{stem}.png'; or a backdrop '#rrggbb'
--since PNG           the unedited view: paint only what differs; 'nothing': paint all pixels
--blend MODE          over (default), multiply, screen, add, erase or replace
--opacity X           opacity of the paint, 0 to 1 (default 1)
--channel NAME        channel to paint or to draw (default base_color)
--max-depth N         finest level of paint; cells are then 1/4 to 1/2 pixel wide (default 1/2 to 1)
--max-angle DEGREES   skip surface tilted more (default 75; 85 for views); 75,both: paint back faces;
                      75,hidden: paint hidden surface
--edge-feather PIXELS fade paint toward the image's border and toward edges in depth (default 0)
--pictures MODE       how images combine: average, best, or robust (default for three or more)
--balance MODE        match exposures: gain; full: each colour, and vignetting
--reference IMAGE     the image that --balance and --refine-cameras do not change
--refine-cameras JSON turn, move and zoom cameras until the images agree; write them
--holes MODE          unseen part of a new texture: smooth (default), leave, or a colour #rrggbb
--coverage            also store how much of each cell is painted, as the channel coverage
--resume FOLDER       store finished stages here, and reuse them in a later run
--layer-out LAYER     also write the paint alone, .octex; give it as an IMAGE later
--preview PNG         also draw the original and the texture side by side

--as KIND             panels (default): side by side with captions; view: one image, lit; paint: unlit,
                      to paint on; cells: leaves as cubes; difference: how both differ
--size W,H            width and height in pixels
--direction X,Y,Z     direction from the model to the camera (default: the side with most detail)
--up X,Y,Z            direction that points up in the image (default 0,1,0)
--zoom TIMES          enlarge by this factor (default 1: the whole model)
--level N             draw this level of the texture (default: the finest, or what a pixel shows)
--light LIGHT         soft: on base colours only; or on all materials: studio, or a panorama .hdr, .exr
--exposure STOPS      double the --light this many times (default 0)
--bump CHANNEL=H      bend the normals as if the surface rose by H where the channel is 1
--camera-out JSON     write the camera of the image, to paint it back
--empty-layer PNG     also write a transparent image of the same size, to draw on

--uv MODE             auto (default): keep UVs unless they overlap; keep; atlas: new ones; or xatlas:
                      new ones, cut by xatlas (slow for scans)
--texture-size N      width and height of the images (default: texels as wide as leaves, or up to 4
                      times finer where images would be off by more than 3/255 RMS)
--triangles N         reduce the mesh to N triangles, like 50k; a normal map stores lost detail
--original MODEL      the model of the texture, where MODEL is a simpler mesh of it
--max-distance D      largest distance to the surface of --original, in its units (default: any)
--padding N           texels around each chart (default 8)
--image-format NAME   png (default), webp, jpeg, jpeg-all, png16 or exr
--supersample N       average this many lookups along each side of a texel (default 1)
--vertex-colors       write colours at the vertices, no images; always so in .ply and .3mf
--max-edge SIZE       divide triangles until no edge is longer (default: keep them); auto (default for
                      .3mf and with --vertex-error): until colours are within --vertex-error
--vertex-error N      largest error of vertex colours, in 1/255 (default 8)
--displace CHANNEL=H  move the surface by H where the channel is 1; CHANNEL=H,M: by 0 where it is M
--octree              let a .glb or .gltf carry the texture too, for octex-three (EXT_octree_texture)
--unit UNIT           unit of length in .3mf, USD: meter (default), centimeter, millimeter, inch, foot

--part NAME           show only this part of a folder
--port N              port of 127.0.0.1 (default: the same one each time for a file, if it is free)
--paint OUTPUT        paint in the page; Ctrl-S saves the texture here, .octex or .octz
--keep WHAT           if the texture was edited after its layers were saved: shown continues with the
                      edit and no layers, layers without the edit
--recover             repeat the unsaved strokes of an earlier session
--no-browser          print the page's address, and do not open a browser
--max-size SIZE       leave out the finest levels until the page is no larger, like 20MB

--points N            number of points at which a model is compared (default 1,000,000)
--force               overwrite existing files
--threads N           number of threads (default: all processors)
--quiet               print only errors, and the results of diff, overlaps and --json
--json                print the result as one JSON object
"""
#: Parsers of option values; options in no row are flags.
_READERS: dict[Callable[[str], Any], str] = {
    v.depth: "--depth --max-depth",
    v.whole_number: "--level --texture-size --padding --supersample",
    v.count: "--threads --points",
    v.thousands: "--triangles",
    v.length: "--cell --margin --blur --zoom --max-distance",
    v.real: "--exposure",
    v.codes: "--max-error --vertex-error",
    v.whole_codes: "--loss",
    str: "--detail --pose --channel --part",
    v.channel_names: "--channels",
    v.dtypes: "--dtype",
    size_of: "--memory --max-size",
    v.file_here: "--rest --also --transfer --since --reference --original",
    v.output_file: "--refine-cameras --resume --layer-out --preview --camera-out --empty-layer --paint",
    v.texture_file: "--combine",
    v.file_and_amount: "--mix",
    v.subdivision: "--subdiv",
    v.grid: "--grid",
    v.cells_apart: "--separate",
    v.source: "--source",
    v.projected: "--project",
    v.near: "--within",
    v.box: "--crop",
    v.levels: "--levels",
    v.camera: "--camera",
    v.disc: "--unwrap",
    v.mask: "--mask",
    v.opacity: "--opacity",
    v.angle_and_sides: "--max-angle",
    v.pixels: "--edge-feather",
    v.holes: "--holes",
    v.image_size: "--size",
    v.direction: "--direction --up",
    v.light: "--light",
    v.bump: "--bump",
    v.edge_length: "--max-edge",
    v.displacement: "--displace",
    v.port_number: "--port",
    v.one_of(*v.FILTERS): "--filter",
    v.one_of(*v.BLENDS): "--blend",
    v.one_of(*v.PICTURES): "--pictures",
    v.one_of(*v.BALANCES): "--balance",
    v.one_of("panels", "view", "paint", "cells", "difference"): "--as",
    v.one_of("shown", "layers"): "--keep",
    v.one_of("auto", "keep", "atlas", "xatlas"): "--uv",
    v.one_of("png", "webp", "jpeg", "jpeg-all", "png16", "exr"): "--image-format",
    v.one_of("meter", "centimeter", "millimeter", "inch", "foot"): "--unit",
}
_REPEATED = "--also", "--source", "--mask"
#: The values of options that are not given, where every command has the same.
_DEFAULTS: dict[str, Any] = {
    "--filter": "ewa",
    "--within": {},
    "--margin": 0.0,
    "--loss": 0,
    "--blend": "over",
    "--opacity": 1.0,
    "--max-angle": {},
    "--edge-feather": 0.0,
    "--as": "panels",
    "--up": (0.0, 1.0, 0.0),
    "--zoom": 1.0,
    "--exposure": 0.0,
    "--image-format": "png",
    "--supersample": 1,
    "--unit": "meter",
    "--port": 0,
}


def _options() -> dict[str, Option]:
    readers = {word: read for read, words in _READERS.items() for word in words.split()}
    rows = re.findall(r"^(--\S+)(?: (\S+))? +(\S.*(?:\n +\S.*)*)$", _TABLE, re.MULTILINE)
    options = {}
    for word, value, help in rows:
        read, text = readers.get(word), " ".join(help.split())
        options[word] = Option(word, value, read, text, word in _REPEATED, _DEFAULTS.get(word))
    return options


OPTIONS = _options()

#: Every command: summary, examples, files (optional ones in brackets) and options.
_COMMANDS = """
convert  Convert a textured model, points, voxels or a function to an octree texture.
  > droid.glb droid.octex --depth 10 --preview droid.png
  > statue.stl statue.octex --source base_color=wood.png --project box
  INPUT    a model, points, voxels, a texture, or FILE.py:NAME, a function that is negative inside
  OUTPUT   NAME.octex, NAME.octz (compressed), or the leaves as points, .ply, .npz; .osl: a shader
  --depth --cell --max-error --detail --channels --dtype --source --project --transfer --within
  --filter SHAPE --repair --also --grid --separate --parts --memory --no-fit --preview RUNNING

view  Show a texture in the browser, until you close the page; or write the page.
  > droid.octex droid.glb
  > droid.octex droid.glb droid.html --max-size 20MB
  > droid.octex droid.glb --paint painted.octex
  [TEXTURE]  a texture, or a folder of parts; without it, the model is converted
  [MODEL]  its model; without it, the page shows the cells
  [PAGE]   NAME.html: write the page, which opens offline; NAME.octw: its data, for three.js
  --depth --part --max-size --paint --keep --recover --port --no-browser SHAPE RUNNING

draw  Draw a texture, a model or both: side by side, one view, or how they differ.
  > droid.octex droid.glb droid.png --light studio
  > droid.octex droid.glb view.png --as paint --camera-out camera.json
  [TEXTURE]  an .octex or .octz file, or its address
  [MODEL]  its model; or another texture, for --as difference
  OUTPUT   NAME.png
  --as --channel --level --size --direction --up --zoom --camera --unwrap --light --exposure --bump
  --camera-out --empty-layer SHAPE RUNNING

paint  Project images through their cameras onto a model, into its texture or a new one.
  > droid.octex droid.glb painted.octex view.png --camera camera.json
  > scan.ply scan.octex photo1.png photo2.png --camera transforms.json --preview scan.png
  [TEXTURE]  its texture; without it, a new one is made
  MODEL    the model, in the pose that the cameras see
  OUTPUT   the painted texture, NAME.octex; with --force it may be TEXTURE
  [IMAGE ...]  images named as their cameras (or IMAGE=CAMERA), or layers; default: of --camera
  --camera --unwrap --mask --since --blend --opacity --channel --max-depth --max-angle --edge-feather
  --pictures --balance --reference --refine-cameras --holes --coverage --no-fit --memory --resume SHAPE
  --layer-out --preview RUNNING

bake  Write a model with images, or vertex colours, of a texture, for other programs.
  > droid.octex droid.glb baked.glb
  > droid.octex droid.glb web.glb --texture-size 1024 --image-format webp
  > scan.ply scan.glb --triangles 50k --texture-size 2048
  [TEXTURE]  an .octex or .octz file, or its address; without it, the model's own colours
  MODEL    the model of the texture; with --original, a simpler mesh of the same object
  OUTPUT   NAME.glb, .gltf, .obj, .usdz, .usd, .usda, .usdc, .3mf, .ply or .ptx
  --uv --texture-size --padding --channels --image-format --supersample --triangles --original
  --max-distance
  --vertex-colors --max-edge --vertex-error --displace --octree --unit SHAPE --repair RUNNING

edit  Crop, coarsen, combine, blur or recolour a texture. Options are applied in the order listed here.
  > droid.octex coarse.octex --depth 7
  > droid.octex worn.octex --levels 0.1,0.75,1.3 --blur 0.02
  TEXTURE  an .octex or .octz file, or its address
  OUTPUT   NAME.octex, NAME.octz (compressed), or the leaves as points, .ply, .npz; .osl: a shader
  --crop --depth --combine --mix --blur --levels --channels --dtype --loss RUNNING

info  Print a texture's contents, and the size of each part of its file.
  > droid.octex
  TEXTURE  an .octex or .octz file, its address, or a folder of parts
  --json

diff  Print how two textures, or a texture and a model, differ over the surface.
  > droid.octex droid.glb
  > before.octex after.octex --channels base_color --json
  TEXTURE  an .octex or .octz file, or its address
  OTHER    its model, or another texture; the exit code is 0 however they differ
  --channels --points --source --rest --subdiv --threads --quiet --json

validate  Check a texture, and print what is broken.
  > droid.octex
  > robot/ --quiet
  TEXTURE  an .octex or .octz file, its address, or a folder of parts
  --quiet --json

overlaps  List parts of a model that intersect or nearly touch: their colours would mix.
  > robot.glb --margin 0.01
  MODEL    the model; the exit code is 0 also if parts overlap
  --margin --rest --threads --quiet --json

warm-up  Compile everything now, so that later commands start at once.
  >
  --quiet
"""
#: Text in help instead of "default 10", for commands with another default depth.
_DEPTHS = {"view": "default 9", "edit": "default: all"}
#: Options of a model's shape, and those that change no result.
SHAPE, RUNNING = ("--rest", "--pose", "--subdiv"), ("--force", "--threads", "--quiet", "--json")
_SHORT = {"SHAPE": SHAPE, "RUNNING": RUNNING}
_FILES: dict[str, Callable[[str], Any]] = {
    **dict.fromkeys(("INPUT", "TEXTURE", "OTHER"), v.texture_file),
    **dict.fromkeys(("OUTPUT", "PAGE"), v.output_file),
    **dict.fromkeys(("MODEL", "IMAGE"), v.file_here),
}
#: Whether a word may be this optional file.
_FITS: dict[str, Callable[[str], bool]] = {
    "TEXTURE": v.is_texture_name,
    "MODEL": lambda word: not word.lower().endswith((v.PAGE_ENDING, v.WEB_ENDING, ".png", ".jpg", ".jpeg")),
}


def _command(text: str) -> Command:
    """Return the command of a paragraph of the table."""
    first, *lines = text.splitlines()
    name, summary = first.split("  ", 1)
    files, options, examples = [], [], []
    for line in map(str.strip, lines):
        if line.startswith(">"):
            examples.append(line[1:].strip())
        elif match := re.fullmatch(r"(\[?)([A-Z]+)( ...)?\]?  +(.*)", line):
            bracket, word, dots, help = match.groups()
            read = v.texture_file if (name, word) == ("draw", "MODEL") else _FILES[word]
            number: Any = "any" if dots else "maybe" if bracket else "one"
            files.append(File(word, read, help, number, _FITS.get(word, bool)))
        else:
            options += [OPTIONS[each] for word in line.split() for each in _SHORT.get(word, (word,))]
    depth = _DEPTHS.get(name, "default 10")
    options = [each._replace(help=each.help.replace("default 10", depth)) for each in options]
    return Command(name, summary, files, options, examples)


COMMANDS = {each.name: each for each in map(_command, _COMMANDS.strip().split("\n\n"))}
