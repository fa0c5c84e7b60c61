"""What commands refuse, in one line: nothing is written then."""

import re

import numpy as np
import pytest

import octex
from octex.cli.options import COMMANDS
from octex.errors import ExitCode
from tests.make.command import run
from tests.make.fixtures import ply, ply_square

#: Words of a command and what is said of them before "; see … --help"; without one, of octree-convert.
USAGE = r"""
 → INPUT OUTPUT are missing
a.glb → OUTPUT is missing
a.glb b.octex c → c is one file too many for octree-convert INPUT OUTPUT
a.glb b.octex --dept 3 → --dept is not an option: do you mean --depth
a.glb b.octex --depth x → --depth: 'x' is not a whole number
a.glb b.octex --depth → --depth needs a value, N
a.glb b.octex --depth 3 --depth 4 → --depth is given twice; it takes one value
a.glb b.octex --depth -1 → --depth: -1 is not from 0 to 21
a.glb b.octex --depth 22 → --depth: 22 is not from 0 to 21
a.glb b.octex --cell x → --cell: 'x' is not a number
a.glb b.octex --cell 0 → --cell: 0 is not a finite number above zero
a.glb b.octex --threads 0 → --threads: 0 is not above zero
a.glb b.octex --threads x → --threads: 'x' is not a whole number
a.glb b.octex --points 9 → --points is an option of octex diff, not of octree-convert
a.glb b.octex --separate → --separate needs a value, CELLS
a.glb b.octex --channels base_color,, → --channels: 'base_color,,' has an empty name; write base_color,normal
a.glb b.octex --channels a,b,a → --channels: a is named twice
a.glb b.octex --dtype int8 → --dtype: 'int8' is not one of uint8, uint16, float16, float32
a.glb b.octex --dtype normal=uint16,alpha → --dtype: 'alpha' is not NAME=TYPE, such as normal=uint16
a.glb b.octex --dtype normal=uint16,normal=uint8 → --dtype: normal is named twice
a.glb b.octex --filter cubic → --filter: 'cubic' is not one of nearest, bilinear, bicubic, trilinear, ewa
a.glb b.octex --source roughness → --source: 'roughness' is not CHANNEL=FILE, such as roughness=rough.png
a.glb b.octex --max-error two → --max-error: 'two' is not a number
a.glb b.octex --max-error -1 → --max-error: -1 is not a finite number from 0 on
a.glb b.octex --max-error inf → --max-error: inf is not a finite number from 0 on
a.glb b.octex --crop 0,0,0,1,1,1 → --crop is an option of octex edit, not of octree-convert
a.glb b.octex --combine b.octex → --combine is an option of octex edit, not of octree-convert
a.glb b.octex --project cone → --project: 'cone' is not one of planar, box, cylindrical, spherical
a.glb b.octex --project box:size → --project: 'size' is not one of axis=A, center=X,Y,Z, size=SIZE, such as …
a.glb b.octex --project box:axis=w → --project: axis: 'w' is not one of x, -x, y, -y, z, -z
a.glb b.octex --project box:center=1,2 → --project: center: '1,2' is not X,Y,Z, such as 0,0.5,1
a.glb b.octex --project box:center=a,b,c → --project: center: 'a,b,c' must be numbers separated by commas
a.glb b.octex --project box:center=1,nan,2 → --project: center: 1,nan,2 has numbers that are not finite
a.glb b.octex --project box:size=0 → --project: size: '0' is not a size above zero, nor three like 1,1,0.5
a.glb b.octex --source alpha=a.png --project spherical:size=2 → --project: a spherical projection has no …
wide.ply x.octex --within 1,181 → --within: 181 is not from 0 to 180
wide.ply x.octex --transfer green.npz --within mean:0 → --within: 0 is not a finite number above zero
convert a.glb b.octex --qqq → --qqq is not an option
convert a.octex b.glb --uv keep → --uv is an option of octex bake, not of octex convert
view a.octex b.html c.glb → c.glb stands in the wrong place: write octex view [TEXTURE] [MODEL] [PAGE]
view a.octex --port 0 → --port: 0 is not a port from 1 to 65535
view a.octex --max-size much → --max-size: 'much' is not a size like 20MB
draw → OUTPUT is missing
draw box.octex box.glb v.png --as paint --camera-out c.json --direction 0,0,0 → --direction: must not be 0,0,0
draw box.octex box.glb v.png --bump roughness → --bump: 'roughness' is not CHANNEL=HEIGHT, such as …
draw x.png → --as panels needs a TEXTURE
draw box.glb x.png --as cells → --as cells needs a TEXTURE
draw box.octex x.png --as paint → --as paint needs a MODEL
paint → MODEL OUTPUT are missing
paint m.glb → OUTPUT is missing
paint t.octex m.glb → OUTPUT is missing
paint a.glb --camera → --camera needs a value, FILE[#NAME]
paint t.octex m.glb o.octex --size 3,3 → --size is an option of octex draw, not of octex paint
paint t.octex m.glb o.octex --camera-out c.json → --camera-out is an option of octex draw, not of octex paint
paint t.octex m.glb o.octex --blend burn → --blend: 'burn' is not one of over, multiply, screen, add, …
paint t.octex m.glb o.octex --opacity 2 → --opacity: 2 is not from 0 to 1
paint t.octex m.glb o.octex --opacity x → --opacity: 'x' is not a number
paint t.octex m.glb o.octex --opacity nan → --opacity: nan is not from 0 to 1
paint t.octex m.glb o.octex --max-angle 181 → --max-angle: 181 is not from 0 to 180
paint t.octex m.glb o.octex --max-angle= → --max-angle: '' is not a number
paint t.octex m.glb o.octex --edge-feather 1e7 → --edge-feather: 1e7 is not from 0 to 1000000
paint m.glb o.octex --holes red → --holes: 'red' is not R,G,B from 0 to 255, nor #rrggbb, nor leave or smooth
paint m.glb o.octex --holes 1,2 → --holes: '1,2' is not R,G,B from 0 to 255, nor #rrggbb, nor leave or smooth
paint m.glb o.octex --holes 1,2,256 → --holes: 1,2,256 is not from 0 to 255, nor leave or smooth
paint t.octex m.glb o.octex --camera c# → --camera: 'c#' names no camera; write FILE#NAME, or FILE
paint t.octex m.glb o.octex --camera c --max-depth 22 → --max-depth: 22 is not from 0 to 21
bake a.glb b.octex c.glb → b.octex stands in the wrong place: write octex bake [TEXTURE] MODEL OUTPUT
bake box.glb x.glb --triangles 0 → --triangles: '0' is not a number like 50k, 1.5M or 50000
bake box.octex box.glb x.ply --displace base_color → --displace: 'base_color' is not CHANNEL=HEIGHT[,MIDDLE]…
edit a.octex b.octex --dpeth=3 → --dpeth is not an option: do you mean --depth
edit a.octex b.octex --crop 0,0,0,1,1 → --crop: '0,0,0,1,1' is not x0,y0,z0,x1,y1,z1, such as 0,0,0,1,2,1
edit a.octex b.octex --crop 0,0,0,1,1,nan → --crop: 0,0,0,1,1,nan has numbers that are not finite
edit a.octex b.octex --levels 0.5 → --levels: '0.5' is not BLACK,WHITE[,GAMMA], such as 0.1,0.9,1.2
edit a.octex b.octex --levels 0.5,0.4 → --levels: '0.5,0.4' is not BLACK,WHITE[,GAMMA], such as 0.1,0.9,1.2
edit a.octex b.octex --levels a,b → --levels: 'a,b' must be numbers separated by commas
edit a.octex b.octex --mix b.octex → --mix: 'b.octex' is not FILE=AMOUNT, such as other.octex=0.3
edit a.octex b.octex --mix b.octex=2 → --mix: 2 is not from 0 to 1
edit a.octex b.octex --loss 0.5 → --loss: '0.5' is not a whole number
edit a.octex b.octex --blur 0 → --blur: 0 is not a finite number above zero
info → TEXTURE is missing
info a.octex b.octex → b.octex is one file too many for octex info TEXTURE
diff a.octex → OTHER is missing
diff a.octex b.octex --depth 3 → --depth is an option of octex convert, octex view, octex edit, not of …
validate a b → b is one file too many for octex validate TEXTURE
validate a.octex --json=1 → --json takes no value
overlaps a.glb --margin --json → --margin needs a value, SIZE
box.glb x.octex --subdiv limit → --subdiv: 'limit' is not a whole number
box.glb x.octex --subdiv 1,cage → --subdiv: 'cage' is not one of hull, limit
warm-up now → now is one file too many for octex warm-up
"""
#: The same of what is no matter of usage; … stands for any text.
REFUSALS = r"""
a.glb b.octex --depth 0 --cell 1 → --depth and --cell both set the cell size; give one of them
a.glb b.octex --source alpha=1 --source alpha=0 → --source gives alpha twice
a.glb b.octex --channels normal --source alpha=1 → --source gives alpha, but --channels leaves it out
a.glb b.octex --project box → --project needs an image to project: --source base_color=FILE
a.glb b.octex --project box --source alpha=1 → --project needs an image to project: --source base_color=FILE
a.octex b.octex --source alpha=a.png --project box → a.octex: --source needs the model, but this is a …
box.glb x.octex --depth 3 --detail wear → unknown detail 'wear'; there are: base_color, stretch
box.glb x.octex --depth 3 --detail base_color → --detail must be a channel with one component in 0 … 1, and …
box.glb x.octex --channels base_color --detail stretch --source stretch=1 → --source gives stretch, but …
box.glb x.octex --subdiv 0 → levels must be a whole number from 1 to 10, not 0
box.glb x.octex --pose B@1 → box.glb has no animations; leave the pose 'B@1' out
draw box.glb v.png --as paint --camera-out c.json --pose B@1 → box.glb has no animations; leave …
box.glb x.octex --also box.glb --pose A@1 → --pose applies to one model; …
shapes.py:ball x.octex --pose A@1 → --pose applies to meshes, not to functions
box.glb b.ply --memory 9kB → b.ply: a texture is converted to NAME.octex
box.glb x.octex --depth 3 --channels normal → box.glb has no channel normal; it has base_color
box.glb x.octex --depth 3 --dtype normal=uint16 → unknown channel of dtype 'normal'; there are: base_color
box.glb x.octex --source alpha=missing.png → box.glb has no texture coordinates for an image of alpha; give …
box.glb x.octex --preview x.gif → x.gif: --preview has the ending '.gif'; octex writes .png here
box.glb x.octex --preview there.png → there.png: exists already; --force overwrites it
box.glb there.octex --depth 3 → there.octex: exists already; --force overwrites it
box.glb x.octex --rest wide.ply → wide.ply cannot be the rest mesh of box.glb: the topology differs (4 …
box.octex x.octex → box.octex: is an octree texture already; octex edit makes it coarser or smaller
missing.glb x.ply → missing.glb cannot be read: No such file or directory
empty.glb x.ply → empty.glb is empty; export the model again
broken.gltf x.ply → broken.gltf is not a glTF file, or is damaged (Expecting property name enclosed in …
words.txt x.ply → words.txt is not a model that octex reads; it reads .glb, .gltf, .obj, .ply, .off, .stl, …
folder.glb x.ply → folder.glb cannot be read: Is a directory
missing.octex x.ply → missing.octex: cannot be read: No such file or directory
empty.octex x.ply → empty.octex: is not an octree texture file (it does not begin …; octex convert makes one
words.octex x.ply → words.octex: is not an octree texture file (it does not begin …; octex convert makes one
wide.ply x.octex --within mean:1 → --within needs --transfer
green.npz x.octex --max-error 2 → green.npz: --max-error needs a surface, and these are points
green.npz x.octex --transfer red.ply → green.npz: --transfer needs a surface, and these are points
wide.ply x.octex --transfer none.ply → none.ply cannot be read: No such file or directory
wide.ply x.octex --transfer red.obj --within mean:1 → red.obj is not a point cloud that octex reads; it …
wide.ply red.ply --transfer red.ply --force → red.ply: OUTPUT is also an input; give it another name
shapes.py:ball x.octex → shapes.py:ball is a function: give --grid x0,y0,z0,x1,y1,z1,EDGE too
wide.ply x.octex --grid 0,0,0,1,1,1,1 → --grid applies to implicit surfaces only: FILE.py:NAME
wide.ply x.octex --source base_color=shapes.py:blue → shapes.py has no function blue; it has red, ball
wide.ply x.octex --source base_color=shapes.py:three → shapes.py has no function three; it has red, ball
wide.ply x.octex --source base_color=none.py:red → none.py cannot be read: No such file or directory
wide.ply x.octex --source base_color=broken.py:red → broken.py raised SyntaxError: invalid syntax …
wide.ply x.octex --also red.ply --rest wide.ply → --rest applies to one model; leave out --also
wide.ply x.octex --also none.ply → none.ply cannot be read: No such file or directory
wide.ply x.octex --also wide.ply --repair → --repair applies to one model; leave out --also
shapes.py:ball x.octex --repair --grid=-2,-2,-2,2,2,2,1 → --repair applies to meshes, not to functions
wide.ply x.octex --parts → x.octex: --parts writes a folder; give OUTPUT no ending
wide.ply x --parts --separate 3 → --separate cannot be used with --parts
wide.ply x --parts --preview a.png → --preview cannot be used with --parts
wide.ply x --parts --memory 1GB → --memory cannot be used with --parts
box.octex x --parts → box.octex: --parts needs the model, but this is a texture made from it; see octex edit
green.npz x --parts → green.npz: --parts needs a surface, and these are points
wide.ply there.png --parts → there.png: is a file; --parts writes a folder, give OUTPUT another name
wide.ply no/folder --parts → no/folder: there is no folder no; make it first
wide.ply made --parts → made: holds a texture set already; --force replaces it
convert shapes.py a.octex → shapes.py: name the function in it, like shapes.py:NAME
convert a.glb b.glb → b.glb: a texture is baked onto its model: octex bake TEXTURE a.glb b.glb
convert a.octex b.ptx → b.ptx: a texture is baked onto its model: octex bake TEXTURE MODEL b.ptx
convert a.glb b.html → b.html: a page is written by octex view TEXTURE a.glb b.html
view a.octex --depth 3 → --depth is for models; choose the level of a.octex in the page
view a.glb b.glb → b.glb: PAGE has the ending '.glb'; octex writes .html and .octw here
view a.octex --max-size 1MB → --max-size is for pages, NAME.html
view a.octex a.html --port 80 → --port cannot be used when a page is written
view a.octex --part x → --part needs a folder of parts; a.octex is not one
view a.octex --rest b.glb → --rest needs a MODEL
view a.octex --paint b.octex → --paint needs a MODEL
view a.octex a.glb --recover → --recover needs --paint
view a.octex a.glb --paint a.octex → a.octex: --paint is also an input; give it another name
view a.octex a.glb --paint b.png → b.png: --paint has the ending '.png'; octex writes .octex and .octz here
view a.octex a.glb a.html --paint b.octex → --paint cannot be used when a page is written
view box.octex box.glb --paint out.octex → out.layers.octex: exists already; --force overwrites it
view a.octex a.glb --paint there.octex → there.octex: exists already; --force overwrites it
draw box.octex box.glb v.png --as paint → --as paint without --camera needs --camera-out: only with its …
draw box.octex box.glb v.png --as paint --camera c.json --direction 0,0,1 → --direction cannot be used with …
draw box.octex box.glb v.png --as paint --camera c.json --up 0,0,1 → --up cannot be used with --camera; …
draw box.octex box.glb v.png --as paint --camera-out c.json --exposure 1 → --exposure needs --light
draw box.octex box.glb v.png --as paint --camera-out c.json --bump alpha=1 → --bump needs --light
draw box.octex box.glb v.png --as paint --camera-out c.txt → c.txt: --camera-out has the ending '.txt'; …
draw box.octex box.glb v.png --as paint --camera-out c.json --empty-layer folder.glb/v.png → --empty-layer …
draw box.octex box.glb v.png --exposure 1 → --exposure needs --light
draw box.octex box.octex x.png → box.octex: is a texture too; --as difference draws how two differ
draw box.glb x.png --level 3 → --level is a level of a TEXTURE
draw box.octex box.glb x.png --camera-out c.json → --camera-out cannot be used with --as panels
draw box.octex box.glb x.jpg → x.jpg: OUTPUT has the ending '.jpg'; octex writes .png here
draw box.octex box.glb v.png --quiet --light missing.hdr → missing.hdr cannot be read: No such file or …
draw box.octex box.glb v.png --quiet --bump height=1 → unknown channel to bend normals by 'height'; there …
paint t.octex m.glb o.octex a.png l.octex → l.octex: is a layer; merge layers and paint images one after …
paint t.octex m.glb o.octex l.octex --balance full → --balance cannot be used with layers
paint t.octex m.glb o.octex l.octex --camera c → --camera cannot be used with layers
paint t.octex m.glb o.octex l.octex --mask m.png → --mask cannot be used with layers
paint t.octex m.glb o.octex l.octex --channel alpha → --channel cannot be used with layers
paint t.octex m.glb o.octex l.octex --layer-out x.octex → --layer-out cannot be used with layers
paint t.octex m.glb o.octex l.octex --max-depth 3 → --max-depth cannot be used with layers
paint t.octex m.glb o.octex → --camera is missing: give the file with the cameras; see octex help cameras
paint m.glb o.octex a.png --camera c --blend erase → --blend erase needs a TEXTURE to erase; …
paint m.glb o.octex a.png --camera c --reference a.png → --reference needs --balance or --refine-cameras
paint m.glb o.octex a.png --camera c --mask 1,2,3 --mask #ffffff → --mask gives several backdrop colours; …
paint m.glb o.octex a.png --camera c --mask {stem}.png --mask a.png → --mask gives a pattern and more …
paint t.octex m.glb o.ply --camera c → o.ply: OUTPUT has the ending '.ply'; octex writes .octex here
bake box.octex box.glb x.usdz --image-format webp → x.usdz: USD holds no webp images; write png, jpeg or exr
bake box.octex box.glb x.glb --image-format exr → x.glb: glTF holds no exr images; write a .obj or .usdz, …
bake box.octex box.glb x.ply --uv keep → --uv cannot be used with vertex colours
bake box.octex box.glb x.glb --max-edge 1 → --max-edge is for vertex colours; add --vertex-colors
bake box.octex box.glb x.ply --max-edge 1 --vertex-error 2 → --vertex-error needs --max-edge auto
bake box.octex box.glb x.obj --unit inch → --unit has no effect on x.obj: the format stores no unit
bake box.octex box.glb x.obj --octree → --octree has no effect on x.obj: only .glb and .gltf carry it
bake box.octex box.glb x.glb --triangles 9 --displace alpha=1 → --displace cannot be used with --triangles
bake box.octex box.glb x.glb --triangles 9 --uv keep → --uv keep cannot be used with --triangles: the mesh …
bake box.octex box.glb x.glb --texture-size 1 → --texture-size must be a whole number from …
bake box.octex box.glb x.obj --vertex-error 4 → --vertex-error is for vertex colours; add --vertex-colors
bake box.glb x.glb --triangles 9k --original box.glb → --original cannot be used with --triangles
bake box.glb x.glb --triangles 9k --vertex-colors → --triangles cannot be used with vertex colours
bake box.glb x.ptx → x.ptx: needs a texture; octex convert makes one of the model
bake box.octex box.glb x.ptx --uv keep → --uv cannot be used for x.ptx
edit box.glb x.octex --blur 1 → box.glb: is a model without EXT_octree_texture; octex convert makes a …
edit box.octex x.octex --depth 5 → box.octex: has depth 4; for --depth 5 convert the model again
edit box.octex x.octex --loss 1 → --loss is for NAME.octz
edit box.octex x.octex --combine none.octex → none.octex: cannot be read: No such file or directory
edit box.octex x.octex --channels paint → unknown channel of box.octex: 'paint'; there are: base_color
edit box.octex there.octex --combine there.octex --force → there.octex: OUTPUT is also an input; give it …
edit box.octex there.octex --mix there.octex=0.5 --force → there.octex: OUTPUT is also an input; give it …
info missing.octex → missing.octex: cannot be read: No such file or directory
info . → .: is not the folder of a texture set: it has no set.json
bake . box.glb x.glb → .: is a folder; give a texture's file (view, info and validate read folders of …
diff a.obj b.obj → a.obj: is not a .octex file; octex convert makes one from a model
diff a.octex b.octex --points 10 → --points needs a model, but a.octex and b.octex are textures
diff a.octex b.octex --rest a.obj → --rest needs a model, but a.octex and b.octex are textures
diff a.octex b.octex --subdiv 2 → --subdiv needs a model, but a.octex and b.octex are textures
diff a.octex b.octex --source alpha=1 → --source needs a model, but a.octex and b.octex are textures
diff box.octex missing.octex → missing.octex: cannot be read: No such file or directory
diff box.octex missing.glb → missing.glb cannot be read: No such file or directory
validate missing.octex → missing.octex: No such file or directory
validate . → set.json: No such file or directory
"""
FILES = {
    "shapes.py": "three = 3\ndef red(points): return points\ndef ball(points): return points[:, 0]\n",
    "broken.py": "def red(:\n", "empty.glb": "", "broken.gltf": "{", "words.txt": "words", "empty.octex": "",
    "words.octex": "words and words and words", "there.octex": "", "there.png": "",
    "out.layers.octex": "",
}  # fmt: skip


def rows(table):
    return [tuple(map(str.strip, line.split("→"))) for line in table.splitlines() if line]


@pytest.fixture(scope="module")
def folder(made, tmp_path_factory):
    """A box and its texture, a red square, the same without colours, points, and files that are broken."""
    folder = tmp_path_factory.mktemp("refused")
    for path in (made, made.with_suffix(".glb")):
        (folder / path.name).write_bytes(path.read_bytes())
    for name, content in FILES.items():
        (folder / name).write_text(content)
    red = {name: ("uchar", [255 * (name == "red")] * 4) for name in ("red", "green", "blue")}
    ply(folder / "red.ply", ply_square(**red))
    wide = ply(folder / "wide.ply", ply_square())
    np.savez(folder / "green.npz", points=np.eye(3), colors=np.tile(np.uint8([0, 255, 0]), (3, 1)))
    (folder / "folder.glb").mkdir()
    octex.convert_set(wide, depth=2).save(folder / "made")
    return folder


def contents(folder):
    files = [path for path in folder.rglob("*.*") if path.is_file() and path.suffix != ".pyc"]
    return {path: path.read_bytes() for path in files}


@pytest.mark.parametrize(
    ("words", "message", "is_usage"),
    [(*row, table is USAGE) for table in (USAGE, REFUSALS) for row in rows(table)],
)
def test_a_refusal_is_one_line_and_changes_nothing(words, message, is_usage, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    before = contents(folder)
    assert run(*words.split()) == ExitCode.REFUSED
    first = words.partition(" ")[0]
    program = f"octex {first}" if first in COMMANDS else "octree-convert"
    end = f"; see {program} --help" if is_usage else ""
    expected = re.escape(f"{program}: error: {message}{end}").replace("…", ".*")
    told, said = capsys.readouterr()
    assert told == ""
    assert re.fullmatch(f"{expected}\n", said)
    assert contents(folder) == before
