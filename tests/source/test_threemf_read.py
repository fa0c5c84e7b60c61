"""3MF packages as octex reads them: colours, images, components and parts, and what is refused."""

import zipfile

import numpy as np
import pytest

import octex
from octex.channels import srgb_to_linear
from octex.errors import ModelError, ModelWarning
from tests.make.fixtures import saved

#: What a square takes of groups by itself, and the build that shows it.
OWN, BUILD = 'pid="2" pindex="1"', '<build><item objectid="3"/></build>'


def package(path, parts):
    """A package of parts; a model's elements are within its root."""
    root = (
        '<?xml version="1.0" encoding="UTF-8"?><model unit="millimeter" xmlns="{}" xmlns:m="{}" xmlns:p="{}">'
    )
    places = "core/2015/02", "material/2015/02", "production/2015/06"
    head = root.format(*(f"http://schemas.microsoft.com/3dmanufacturing/{place}" for place in places))
    with zipfile.ZipFile(path, "w") as file:
        for name, content in parts.items():
            file.writestr(name, content if isinstance(content, bytes) else f"{head}{content}</model>")
    return path


def square(number, triangles, own=""):
    """An object: a unit square of two triangles."""
    places = "".join(f'<vertex x="{x}" y="{y}" z="0"/>' for x, y in ((0, 0), (1, 0), (1, 1), (0, 1)))
    mesh = f"<mesh><vertices>{places}</vertices><triangles>{triangles}</triangles></mesh>"
    return f'<object id="{number}" {own}>{mesh}</object>'


def test_groups_of_colours_and_base_materials_are_read(tmp_path):
    triangles = (
        '<triangle v1="0" v2="1" v3="2" pid="1" p1="0" p2="1" p3="1"/><triangle v1="0" v2="2" v3="3"/>'
        '<triangle v1="0" v2="2" v3="1" pid="9"/>'
    )
    text = (
        '<resources><m:colorgroup id="1"><m:color color="#FF0000"/><m:color color="#00408080"/>'
        '</m:colorgroup><basematerials id="2"><base displaycolor="#123456"/><base displaycolor="#808080"/>'
        f"</basematerials>{square(3, triangles, OWN)}</resources>{BUILD}"
    )
    surface = octex.load_surface(package(tmp_path / "a.3mf", {"3D/3dmodel.model": text}))
    np.testing.assert_array_equal(surface.triangles, [[0, 1, 2], [0, 2, 3], [0, 2, 1]])
    samples = surface.scatter(300, seed=0)
    found = np.hstack([surface.evaluate(samples), surface.evaluate(samples, "alpha")])
    codes = np.array([[255, 0, 0, 255], [0, 64, 128, 128], [128, 128, 128, 255], [255] * 4]) / 255.0
    codes[:, :3] = srgb_to_linear(codes[:, :3])
    corners = codes[np.array([[0, 1, 1], [2, 2, 2], [3, 3, 3]])]
    expected = np.einsum("nc,ncd->nd", samples.barycentric, corners[samples.triangles])
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_slices_and_beams_are_left_out_with_a_warning(tmp_path):
    extra = 'xmlns:s="http://schemas.microsoft.com/3dmanufacturing/slice/2015/07" s:slicestackid="1"'
    beams = '<b:beamlattice xmlns:b="beams"><b:beams><b:beam v1="0" v2="1"/></b:beams></b:beamlattice></mesh>'
    plain = square(3, '<triangle v1="0" v2="1" v3="2"/>', extra)
    for content, words in ((plain, "slices"), (plain.replace("</mesh>", beams), "beams and slices")):
        path = package(tmp_path / "a.3mf", {"3D/3dmodel.model": f"<resources>{content}</resources>{BUILD}"})
        with pytest.warns(ModelWarning, match=f"a.3mf: octex reads triangles, and leaves out {words};"):
            assert len(octex.load_surface(path).triangles) == 1
    only = square(3, "").replace("</mesh>", beams)
    path = package(tmp_path / "a.3mf", {"3D/3dmodel.model": f"<resources>{only}</resources>{BUILD}"})
    with pytest.raises(ModelError, match=r"a\.3mf has no triangles; octex needs a surface, not slices"):
        octex.load_surface(path)


@pytest.mark.parametrize("painted", ['paint_color="4"', 'slic3rpe:mmu_segmentation="8"'])
def test_filaments_that_a_slicer_painted_are_left_out_with_a_warning(tmp_path, painted):
    content = square(3, f'<triangle v1="0" v2="1" v3="2" {painted}/>', 'xmlns:slic3rpe="http://x"')
    path = package(tmp_path / "a.3mf", {"3D/3dmodel.model": f"<resources>{content}</resources>{BUILD}"})
    with pytest.warns(ModelWarning, match=r"a\.3mf: colours painted in a slicer are not read; export"):
        assert len(octex.load_surface(path).triangles) == 1


def test_an_image_that_no_triangle_uses_changes_nothing(tmp_path):
    places = '<m:tex2coord u="0" v="0"/>'
    text = (
        '<resources><m:texture2d id="1" path="/3D/Textures/a.png" contenttype="image/png"/>'
        f'<m:texture2dgroup id="2" texid="1">{places}</m:texture2dgroup>'
        '<m:colorgroup id="4"><m:color color="#FF0000"/></m:colorgroup>'
        f"""{square(3, '<triangle v1="0" v2="1" v3="2"/>', 'pid="4" pindex="0"')}</resources>{BUILD}"""
    )
    parts = {"3D/3dmodel.model": text, "3D/Textures/a.png": saved(np.zeros((2, 2, 3), np.uint8))}
    surface = octex.load_surface(package(tmp_path / "a.3mf", parts))
    np.testing.assert_array_equal(surface.evaluate(surface.scatter(10)), [[1.0, 0.0, 0.0]] * 10)


def test_images_lie_where_their_coordinates_say(tmp_path):
    image = np.zeros((2, 2, 3), np.uint8)
    image[:, :, 0], image[:, :, 1] = [[10, 200], [10, 200]], [[250, 250], [60, 60]]
    places = "".join(f'<m:tex2coord u="{u}" v="{v}"/>' for u, v in ((0, 0), (1, 0), (1, 1), (0, 1)))
    triangles = "".join(
        f'<triangle v1="0" v2="{b}" v3="{c}" p1="0" p2="{b}" p3="{c}"/>' for b, c in ((1, 2), (2, 3))
    )
    text = (
        '<resources><m:texture2d id="1" path="/3D/Textures/a.png" contenttype="image/png"/>'
        f'<m:texture2dgroup id="2" texid="1">{places}</m:texture2dgroup>'
        f"{square(3, triangles, OWN)}</resources>{BUILD}"
    )
    parts = {"3D/3dmodel.model": text, "3D/Textures/a.png": saved(image)}
    surface = octex.load_surface(package(tmp_path / "a.3mf", parts))
    samples = surface.scatter(2000, seed=0)
    quarters = np.round(4 * samples.rest[:, :2]) / 4
    near = (abs(samples.rest[:, :2] - quarters) < 0.02).all(axis=1) & (quarters % 0.5 == 0.25).all(axis=1)
    column, row = (quarters[near] // 0.5).astype(int).T
    expected = srgb_to_linear(image[1 - row, column] / 255.0)
    assert near.sum() > 5
    np.testing.assert_allclose(surface.evaluate(samples)[near], expected, atol=0.05)


def test_the_build_places_components_of_other_parts_and_mirrors_them(tmp_path):
    faces = '<triangle v1="0" v2="1" v3="2"/><triangle v1="0" v2="2" v3="3"/>'
    root = (
        '<resources><object id="5"><components><component p:path="/3D/a.model" objectid="3" '
        'transform="2 0 0 0 2 0 0 0 2 1 1 1"/></components></object></resources>'
        '<build><item objectid="5"/><item objectid="5" transform="0 1 0 -1 0 0 0 0 1 0 0 7"/>'
        '<item objectid="5" transform="-1 0 0 0 1 0 0 0 1 0 0 0"/></build>'
    )
    other = f"<resources>{square(3, faces)}</resources><build/>"
    kind = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"
    relations = f'<Relationships><Relationship Target="/3D/b.model" Id="r" Type="{kind}"/></Relationships>'
    parts = {
        "3D/b.model": root, "3D/a.model": other, "_rels/.rels": relations.encode()
    }  # fmt: skip
    surface = octex.load_surface(package(tmp_path / "a.3mf", parts))
    placed = np.array([[1, 1, 1], [3, 1, 1], [3, 3, 1], [1, 3, 1.0]])
    turned = np.stack([-placed[:, 1], placed[:, 0], placed[:, 2] + 7], axis=1)
    np.testing.assert_allclose(surface.vertices, np.concatenate([placed, turned, placed * [-1, 1, 1]]))
    a, b, c = surface.vertices[surface.triangles].transpose(1, 0, 2)
    assert (
        np.cross(b - a, c - a)[:, 2] > 0
    ).all()  # a mirrored square is turned over, so that it faces as before


def test_of_blended_materials_one_is_read_with_a_warning(tmp_path):
    faces = '<triangle v1="0" v2="1" v3="2" pid="4" p1="0"/><triangle v1="0" v2="2" v3="3" pid="5" p1="0"/>'
    text = (
        '<resources><m:colorgroup id="1"><m:color color="#FF0000"/><m:color color="#00FF00"/></m:colorgroup>'
        '<basematerials id="2"><base displaycolor="#0000FF"/><base displaycolor="#FFFFFF"/></basematerials>'
        '<m:multiproperties id="4" pids="2 1"><m:multi pindices="0 1"/></m:multiproperties>'
        '<m:compositematerials id="5" matid="2" matindices="0 1"><m:composite values="0.7 0.3"/>'
        f"</m:compositematerials>{square(3, faces)}</resources>{BUILD}"
    )
    with pytest.warns(ModelWarning, match="of materials that are blended one is read"):
        surface = octex.load_surface(package(tmp_path / "a.3mf", {"3D/3dmodel.model": text}))
    samples = surface.scatter(20, seed=0)
    expected = np.array([[0, 1, 0], [0, 0, 1]])[samples.triangles]
    np.testing.assert_array_equal(surface.evaluate(samples), expected)


VERTEX = '<vertex x="0" y="0" z="0"/>'


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (None, "has no part 3D/3dmodel.model"),
        (b"<model", "3D/3dmodel.model is damaged"),
        (b'<!DOCTYPE a [<!ENTITY b "c">]><model/>', "has a document type, which 3MF forbids"),
        ("<resources/><build/>", "has no triangles"),
        ('<build><item objectid="1"/></build>', "object '1' is missing"),
        (
            '<resources><object id="3"><components><component objectid="3"/></components></object>'
            f"</resources>{BUILD}", "object '3' is missing, or contains itself",
        ),
        (
            '<resources><object id="3"><mesh><vertices/><triangles><triangle v1="0" v2="1" v3="2"/>'
            f"</triangles></mesh></object></resources>{BUILD}",
            "a triangle uses vertex 2, but there are 0",
        ),
        (
            '<resources><m:colorgroup id="4"><m:color color="#ff0000"/></m:colorgroup><object id="3" pid="4">'
            f'<mesh><vertices>{3 * VERTEX}</vertices><triangles><triangle v1="0" v2="1" v3="2" p1="1"/>'
            f"</triangles></mesh></object></resources>{BUILD}", "a triangle uses property 1, but there are 1",
        ),
        (f'<resources><m:texture2dgroup id="4" texid="9"/></resources>{BUILD}', "texture '9' is missing"),
        (
            '<resources><m:compositematerials id="5" matid="1" matindices=""><m:composite values="1"/>'
            f"</m:compositematerials></resources>{BUILD}", "compositematerials '5' lacks what it blends",
        ),
    ],
)  # fmt: skip
def test_damaged_packages_are_refused_in_one_line(tmp_path, model, message):
    parts = {} if model is None else {"3D/3dmodel.model": model}
    with pytest.raises(ModelError, match=f"^bad.3mf.*{message}"):
        octex.load_surface(package(tmp_path / "bad.3mf", parts))
    (tmp_path / "bad.3mf").write_bytes(b"PK and no more")
    with pytest.raises(ModelError, match="is damaged, or is not a 3MF package"):
        octex.load_surface(tmp_path / "bad.3mf")


def test_small_packages_that_unpack_to_much_and_components_that_multiply_are_refused(tmp_path):
    path = tmp_path / "a.3mf"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("3D/3dmodel.model", b" " * 3_000_000)
    with pytest.raises(ModelError, match=r"3D/3dmodel.model unpacks to 3,000,000 bytes, more than 200 times"):
        octex.load_surface(path)
    objects = [square(1, '<triangle v1="0" v2="1" v3="2"/>')]
    for number in range(2, 42):
        twice = f'<component objectid="{number - 1}"/>' * 2
        objects.append(f'<object id="{number}"><components>{twice}</components></object>')
    build = '<build><item objectid="{}"/></build>'
    text = f"<resources>{''.join(objects)}</resources>"
    path = package(tmp_path / "a.3mf", {"3D/3dmodel.model": text + build.format(5)})
    assert len(octex.load_surface(path).triangles) == 16
    package(path, {"3D/3dmodel.model": text + build.format(41)})
    with pytest.raises(ModelError, match=r"a.3mf places the same parts too many times"):
        octex.load_surface(path)
