"""OBJ and MTL against an independent reader, polygons that are cut, and what is refused."""

import numpy as np
import pytest

from octex.channels import srgb_to_linear
from octex.errors import ModelError, ModelWarning
from octex.source.load import load_surface
from tests.make.agreement import assert_agrees
from tests.make.fixtures import OBJ_SQUARE, Gltf, obj, png, random_image
from tests.make.refusal import refused

FACES = "f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
WOOD = "newmtl wood\nmap_Kd wood.png\n"


def assert_alike(surface, expected):
    """Two surfaces have the same values, which differ from place to place."""
    samples = expected.scatter(100)
    values = expected.evaluate(samples)
    assert values.std() > 0.05
    np.testing.assert_array_equal(surface.vertices[surface.triangles], expected.vertices[expected.triangles])
    np.testing.assert_array_equal(surface.evaluate(samples), values)


def wooden(tmp_path, mtl=WOOD, faces=FACES, square=OBJ_SQUARE):
    """A textured square of the material ``wood``."""
    return obj(
        tmp_path / "a.obj", square + "usemtl wood\n" + faces, mtl, {"wood.png": png(random_image(4, 4))}
    )


def test_a_texture_is_bound_with_v_up_and_repeats(tmp_path):
    assert_agrees(wooden(tmp_path, square=OBJ_SQUARE.replace("vt 1 1", "vt 2.5 -1.5")))


def test_each_face_keeps_its_material(tmp_path):
    mtl = WOOD + "Kd 0.5 0.25 1\nnewmtl red\nKd 1 0 0\nd 0.5\nnewmtl stone\nmap_Kd stone.png\n"
    faces = [("wood", "1/1 2/2 3/3"), ("red", "1 3 4"), ("stone", "1/4 2/1 4/2"), ("wood", "2/1 3/2 4/4")]
    lines = "".join(f"usemtl {material}\nf {corners}\n" for material, corners in faces)
    images = {"wood.png": png(random_image(4, 4)), "stone.png": png(random_image(3, 5, seed=1))}
    assert_agrees(obj(tmp_path / "a.obj", OBJ_SQUARE + lines, mtl, images), 300)


def test_materials_that_no_face_uses_are_not_read(tmp_path):
    expected = load_surface(wooden(tmp_path))
    mtl = WOOD + "newmtl other\nKd red\nmap_Kd gone.png\n"
    surface = load_surface(wooden(tmp_path, mtl))
    assert [material.name for material in surface.source.materials if material.name] == ["wood"]
    assert_alike(surface, expected)


def test_colours_of_vertices_are_srgb_values(tmp_path):
    lines = "v 0 0 0 1 0 0.5\nv 1 0 0 0 1 0.2\nv 0 1 0 0 0 1\nf 1 2 3\n"
    assert_agrees(obj(tmp_path / "a.obj", lines))
    codes = (
        lines.replace("1 0 0.5", "255 0 127.5").replace("0 1 0.2", "0 255 51").replace("0 0 1\n", "0 0 255\n")
    )
    large = load_surface(obj(tmp_path / "b.obj", codes))
    small = load_surface(tmp_path / "a.obj")
    samples = small.scatter(20)
    np.testing.assert_allclose(large.evaluate(samples), small.evaluate(samples), atol=1e-6)


def test_colours_of_vertices_count_only_where_a_material_has_no_image(tmp_path):
    (tmp_path / "grey.png").write_bytes(png(np.full((2, 2, 3), 204, np.uint8)))
    (tmp_path / "a.mtl").write_text("newmtl image\nmap_Kd grey.png\nnewmtl half\nKd 0.5 0.5 0.5\n")
    vertices = "".join(f"v {x} {y} 0 0.6 0.6 0.6\n" for x, y in ((0, 0), (1, 0), (1, 1), (0, 1)))
    faces = "vt 0 0\nusemtl image\nf 1/1 2/1 3/1\nusemtl half\nf 1/1 3/1 4/1\n"
    surface = load_surface(obj(tmp_path / "a.obj", f"mtllib a.mtl\n{vertices}{faces}"))
    samples = surface.scatter(50)
    light = srgb_to_linear(np.array([0.8, 0.5, 0.6]))
    expected = np.where(samples.triangles == 0, light[0], light[1] * light[2])
    np.testing.assert_allclose(surface.evaluate(samples), np.repeat(expected[:, None], 3, 1), rtol=1e-4)


def test_vertices_without_a_colour_beside_others_are_white_and_a_fourth_number_is_no_colour(tmp_path):
    path = obj(
        tmp_path / "a.obj",
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 5 5 5 0 0 0\nv 6 5 5 0 0 0\nv 5 6 5 0 0 0\nf 1 2 3\nf 4 5 6\n",
    )
    surface = load_surface(path)
    samples = surface.scatter(50)
    np.testing.assert_array_equal(surface.evaluate(samples)[:, 0], samples.triangles == 0)
    surface = load_surface(obj(tmp_path / "a.obj", "v 0 0 0 1\nv 1 0 0 1\nv 0 1 0 0.5\nf 1 2 3\n"))
    assert (surface.evaluate(surface.scatter(5)) == 1).all()


def test_relative_indices_count_from_the_line_they_stand_on(tmp_path):
    first = OBJ_SQUARE + "usemtl wood\nf -4/-4 -3/-3 -2/-2\nf -4/-4 -2/-2 -1/-1\n"
    second = OBJ_SQUARE.replace(" 0\n", " 3\n").replace("vt 0 3", "vt 0 0").replace("vt 1 3", "vt 1 0")
    path = obj(
        tmp_path / "a.obj",
        first + second + "f -4/-1 -3/-2 -2/-3\nf 1/1 2/2 -1/-1\n",
        WOOD,
        {"wood.png": png(random_image(4, 4))},
    )
    surface = assert_agrees(path)
    assert surface.bounds[1, 2] == 3


def test_every_form_of_a_corner_is_understood(tmp_path):
    path = obj(
        tmp_path / "a.obj",
        OBJ_SQUARE + "vn 0 0 1\nf 1 2 3\nf 1/1 3/3 4/4\nf 1//1 2//1 3//1\nf 1/1/1 3/3/1 4/4/1\n",
    )
    surface = load_surface(path)
    np.testing.assert_array_equal(surface.triangles, [[0, 1, 2], [0, 2, 3]] * 2)


def test_the_way_lines_are_written_does_not_matter(tmp_path):
    lines = ["\ufeff# a comment", "\tv  0 0\t0 # here", "v 1e0 +0 -0.0", "v .0 1. 0"]
    lines += ["g x y", "s off", "o z", "l 1 2", "f 1 \\", " 2 3 "]
    path = tmp_path / "a.obj"
    for end, encoding in (("\r\n", "utf-8"), ("\n", "utf-16-le")):
        path.write_bytes(end.join(lines).encode(encoding))
        surface = load_surface(path)
        np.testing.assert_array_equal(surface.vertices, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
        np.testing.assert_array_equal(surface.triangles, [[0, 1, 2]])


@pytest.mark.parametrize(
    ("name", "there"),
    [
        ("wood.png", "wood.png"),
        ("maps/wood.png", "maps/wood.png"),
        ("old wood.png", "old wood.png"),
        ("maps\\wood.png", "maps/wood.png"),
        ("C:\\temp\\my models\\wood.png", "wood.png"),
        ("WOOD.PNG", "wood.png"),
        ("Maps/Wood.png", "wood.PNG"),
    ],
)
def test_images_are_found_beside_the_model_however_their_path_is_written(tmp_path, name, there):
    files = {there: png(random_image(4, 4)), "b.png": png(np.zeros((4, 4, 3), np.uint8))}
    mtl = f"newmtl wood\nmap_Kd {name}\n"
    path = obj(tmp_path / "a.obj", OBJ_SQUARE + "usemtl wood\n" + FACES, mtl, files)
    assert load_surface(path).evaluate(load_surface(path).scatter(50)).std() > 0.05


def test_names_in_the_code_page_of_windows_are_read(tmp_path):
    (tmp_path / "wände.png").write_bytes(png(random_image(4, 4)))
    (tmp_path / "a.mtl").write_bytes("newmtl grün\nmap_Kd wände.png\n".encode("cp1252"))
    lines = "mtllib a.mtl\n" + OBJ_SQUARE + "usemtl grün\n" + FACES
    (tmp_path / "a.obj").write_bytes(lines.encode("cp1252"))
    surface = load_surface(tmp_path / "a.obj")
    assert surface.evaluate(surface.scatter(50)).std() > 0.05


@pytest.mark.parametrize(
    "libraries",
    ["mtllib my wood.mtl # of oak\nmtllib red.mtl dark.mtl", "mtllib my wood.mtl red.mtl dark.mtl"],
)
def test_a_material_file_may_have_blanks_in_its_name_and_there_may_be_several(tmp_path, libraries):
    (tmp_path / "my wood.mtl").write_text(WOOD)
    (tmp_path / "red.mtl").write_text("newmtl red\nKd 1 0 0\n")
    (tmp_path / "dark.mtl").write_text("newmtl dark wood #2\nKd 0 0 0\n")
    (tmp_path / "wood.png").write_bytes(png(random_image(4, 4)))
    lines = f"{libraries}\n" + OBJ_SQUARE
    path = tmp_path / "a.obj"
    path.write_text(
        lines + "usemtl red # a colour\nf 1 2 3\nusemtl dark wood #2\nf 1 3 4\nusemtl wood\nf 1/1 2/2 3/3\n"
    )
    surface = load_surface(path)
    samples = surface.scatter(100)
    values = surface.evaluate(samples)
    np.testing.assert_allclose(values[samples.triangles == 0].mean(axis=0), [1, 0, 0])
    assert (values[samples.triangles == 1] == 0).all()


@pytest.mark.parametrize("lines", [OBJ_SQUARE + "usemtl anything\n", "mtllib gone.mtl\n" + OBJ_SQUARE])
def test_materials_without_a_library_and_a_missing_one_that_no_face_needs_are_white(tmp_path, lines):
    surface = load_surface(obj(tmp_path / "a.obj", lines + FACES))
    assert len(surface.triangles) == 2
    assert (surface.evaluate(surface.scatter(5)) == 1).all()


def test_a_rest_mesh_needs_no_materials(tmp_path):
    rest = obj(
        tmp_path / "rest.obj",
        "mtllib gone.mtl\n" + OBJ_SQUARE.replace("v 1", "v 9") + "usemtl wood\n" + FACES,
    )
    surface = load_surface(wooden(tmp_path), rest=rest)
    np.testing.assert_allclose(surface.bounds[1], [9, 1, 0])


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("", "is empty"),
        ("# nothing\n", "no triangles"),
        (OBJ_SQUARE, "no triangles"),
        (OBJ_SQUARE + "f 1 2\n", "no triangles"),
        (OBJ_SQUARE + "f 1 2 9\n", "a face uses a vertex that is not among the 4"),
        (OBJ_SQUARE + "f 1 2 0\n", "a face uses a vertex that is not among the 4"),
        (OBJ_SQUARE + "f 1/1 2/2 3/7\n", "a face uses a texture coordinate that is not among the 4"),
        (OBJ_SQUARE + FACES + "f 1 2 x\n", "'f 1 2 x' is not a face"),
        (OBJ_SQUARE + "f 1 2 3/1/1/1\n", "is not a face"),
        (OBJ_SQUARE + "f 1 2 /3\n", "is not a face"),
        ("v 0 0 0\nv 1 0\nv 0 1 0\nf 1 2 3\n", "'v 1 0' has too few numbers"),
        ("v 0 0 0\nv 1 0 zero\nv 0 1 0\nf 1 2 3\n", "'v 1 0 zero' is not numbers"),
        ("v 0 0 0\nv 1 0 nan\nv 0 1 0\nf 1 2 3\n", "not all finite"),
        ("v 0 0 0\0\nv 1 0 1\nv 0 1 0\nf 1 2 3\n", "not a text file"),
    ],
)
def test_a_bad_model_is_refused_in_one_line_that_names_it(tmp_path, lines, message):
    with refused(ModelError, message, "bad.obj"):
        load_surface(obj(tmp_path / "bad.obj", lines))


@pytest.mark.parametrize(("square", "faces"), [(OBJ_SQUARE, "f 1 2 3\n" + FACES), ("", "f 1/1 2/2 3/3\n")])
def test_textured_faces_without_coordinates_read_one_texel(tmp_path, square, faces):
    bare = "v 0 0 0\nv 1 0 0\nv 1 1 0\n"
    path = wooden(tmp_path, faces=faces, square=square or bare)
    with pytest.warns(ModelWarning, match=r"a\.obj has 1 textured triangles without texture coordinates"):
        surface = load_surface(path)
    samples = surface.scatter(200, seed=0)
    found = surface.evaluate(samples)[samples.triangles == 0]
    np.testing.assert_allclose(found, np.repeat(found[:1], len(found), axis=0), atol=1e-6)


def test_without_its_library_a_model_is_white_with_a_warning(tmp_path):
    path = obj(tmp_path / "a.obj", "mtllib gone.mtl\n" + OBJ_SQUARE + "usemtl wood\n" + FACES)
    with pytest.warns(
        ModelWarning, match=r"a\.obj: gone\.mtl is missing, so the material wood is white; put it"
    ):
        surface = load_surface(path)
    assert (surface.evaluate(surface.scatter(5)) == 1).all()
    with pytest.raises(ModelWarning, match="gone"):  # as an error it stays what it is
        load_surface(path)
    with pytest.warns(ModelWarning, match="gone"):
        surface = load_surface(path, sources={"base_color": (1.0, 0.0, 0.5)})
    np.testing.assert_allclose(surface.evaluate(surface.scatter(5)), [[1, 0, 0.5]] * 5)
    lines = "mtllib gone.mtl\nmtllib lost.mtl\n" + OBJ_SQUARE + "usemtl wood\nf 1 2 3\nusemtl\nf 1 3 4\n"
    words = "gone.mtl and lost.mtl are missing, so the materials wood, without a name are white; put them"
    with pytest.warns(ModelWarning, match=words):
        load_surface(obj(tmp_path / "b.obj", lines))


def test_faces_of_materials_that_are_not_defined_are_white_with_one_warning(tmp_path):
    lines = OBJ_SQUARE + "usemtl red\nf 1 2 3\nusemtl wood\nf 1 3 4\n"
    path = obj(tmp_path / "a.obj", lines, "newmtl red\nKd 1 0 0\n")
    with pytest.warns(
        ModelWarning, match=r"a\.obj: a\.mtl does not define the material wood, which is white; add"
    ):
        surface = load_surface(path)
    samples = surface.scatter(50)
    np.testing.assert_array_equal(surface.evaluate(samples)[:, 1], samples.triangles == 1)
    lines = "".join(f"usemtl m{number}\nf 1 2 3\n" for number in range(9))
    with pytest.warns(ModelWarning) as said:
        load_surface(obj(tmp_path / "a.obj", OBJ_SQUARE + lines, "newmtl other\n"))
    assert len(said) == 1
    assert "materials m0, m1, m2, m3, m4 and 4 more, which are white" in str(said[0].message)


def test_coordinates_may_lack_v(tmp_path):
    for shorter in (("vt 1 0\n", "vt 0 0\n"), ("vt 0 0\n", "vt 1 0\n", "vt 1 1\n", "vt 0 1\n")):
        square = whole = OBJ_SQUARE
        for line in shorter:
            square = square.replace(line, line[:4] + "\n")
            whole = whole.replace(line, line[:4] + " 0\n")
        assert square.count("vt") == whole.count("vt") == 4
        surface = load_surface(wooden(tmp_path, square=square))
        assert_alike(surface, load_surface(wooden(tmp_path, square=whole)))


FLAT_BLUE = "newmtl wood\nnorm wood.png\n"


def plain_normals(tmp_path, lines):
    """A model whose normal map leaves its normals as they are."""
    image = np.tile(np.array([32768, 32768, 65535], np.uint16), (2, 2, 1))
    return load_surface(obj(tmp_path / "a.obj", lines, FLAT_BLUE, {"wood.png": png(image)}))


def test_normals_are_read_below_normal_maps_and_interpolated(tmp_path):
    normals = np.array([[0, 0, 1], [3, 0, 4], [0, -3, 4], [-1, 0, 0]])
    lines = "".join(f"vn {x} {y} {z}\n" for x, y, z in normals)
    unit = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    for faces, used in (
        ("f 1/1/1 2/2/2 3/3/3\nf 1/1/1 3/3/3 4/4/2\n", [[0, 1, 2], [0, 2, 1]]),
        ("f 1/1/-4 2/2/-3 3/3/-2\nf 1/1/-4 3/3/-2 4/4/-1\n", [[0, 1, 2], [0, 2, 3]]),
    ):
        surface = plain_normals(tmp_path, OBJ_SQUARE + lines + "usemtl wood\n" + faces)
        samples = surface.scatter(50)
        expected = np.einsum("nc,ncx->nx", samples.barycentric, unit[np.array(used)[samples.triangles]])
        expected /= np.linalg.norm(expected, axis=1, keepdims=True)
        np.testing.assert_allclose(surface.evaluate(samples, "normal"), expected, atol=1e-3)


def test_faces_without_normals_are_flat_beside_others_and_alone(tmp_path):
    square = OBJ_SQUARE + "vn 1 0 0\nusemtl wood\n"
    surface = plain_normals(tmp_path, square + "f 1/1/1 2/2/1 3/3/1\nf 1/1/1 3/3 4/4/1\n")
    samples = surface.scatter(50)
    expected = np.where((samples.triangles == 0)[:, None], [1, 0, 0], [0, 0, 1])
    np.testing.assert_allclose(surface.evaluate(samples, "normal"), expected, atol=1e-4)
    surface = plain_normals(tmp_path, square + FACES)
    np.testing.assert_allclose(surface.evaluate(samples, "normal"), [[0, 0, 1]] * 50, atol=1e-4)


def test_faces_without_a_normal_map_keep_their_normals_beside_others(tmp_path):
    lines = OBJ_SQUARE + "vn 1 0 0\nusemtl wood\nf 1/1 2/2 3/3\nusemtl bare\nf 1//1 3//1 4//1\n"
    path = obj(tmp_path / "a.obj", lines, "newmtl bare\nnewmtl wood\nmap_Kd -s 2 wood.png\nnorm wood.png\n")
    (tmp_path / "wood.png").write_bytes(png(np.tile(np.array([255, 128, 128], np.uint8), (2, 2, 1))))
    surface = load_surface(path)
    samples = surface.scatter(50)
    np.testing.assert_allclose(surface.evaluate(samples, "normal"), [[1, 0, 0]] * 50, atol=0.02)


def test_normals_of_the_model_are_kept_if_asked_for_and_there(tmp_path):
    bent = np.array([[0, 0, 1], [0.6, 0, 0.8], [0, 0.6, 0.8], [0, 0, 1]], np.float32)
    lines = OBJ_SQUARE + "".join(f"vn {x} {y} {z}\n" for x, y, z in bent)
    smooth = obj(tmp_path / "smooth.obj", lines + "f 1/1/1 2/2/2 3/3/3\nf 1/1/1 3/3/3 4/4/4\n")
    flat = obj(tmp_path / "flat.obj", lines + FACES)
    gltf = Gltf()
    gltf.show(gltf.primitive(NORMAL=gltf.accessor(bent)))
    bare = Gltf()
    bare.show(bare.primitive())
    for path, has_normals in (
        (smooth, True),
        (gltf.save(tmp_path / "smooth.glb"), True),
        (flat, False),
        (bare.save(tmp_path / "flat.glb"), False),
    ):
        assert load_surface(path).frames is None
        surface = load_surface(path, normals=True)
        if has_normals:
            corners = surface.frames.normals.values[surface.frames.normals.rows]
            np.testing.assert_allclose(corners, bent[surface.triangles], atol=1e-6)
        else:
            assert surface.frames is None


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("vn 0 0 1\nusemtl wood\nf 1/1/1 2/2/1 3/3/2\n", "a face uses a normal that is not among the 1"),
        ("vn 0 1\nusemtl wood\nf 1/1/1 2/2/1 3/3/1\n", "'vn 0 1' has too few numbers"),
    ],
)
def test_bad_normals_count_below_normal_maps_alone(tmp_path, lines, message):
    with pytest.raises(ModelError, match=message):
        plain_normals(tmp_path, OBJ_SQUARE + lines)
    load_surface(tmp_path / "a.obj", channels=["base_color"])


def test_normals_that_are_left_out_are_none_and_those_of_no_direction_are_those_of_their_faces(tmp_path):
    path = obj(tmp_path / "a.obj", "v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1//1 2//2 3//4\n")
    assert load_surface(path, normals=True).frames is None
    lines = OBJ_SQUARE + "vn 0 0 0\nvn nan 0 1\nusemtl wood\nf 1/1/1 2/2/2 3/3/1\n"
    surface = plain_normals(tmp_path, lines)
    np.testing.assert_allclose(surface.evaluate(surface.scatter(5), "normal"), [[0, 0, 1]] * 5, atol=1e-4)


def test_the_first_texture_coordinates_are_kept_where_every_face_has_them(tmp_path):
    surface = load_surface(wooden(tmp_path, "newmtl wood\nmap_Kd -s 5 wood.png\n"))
    corners = surface.vertices[surface.triangles]
    np.testing.assert_allclose(surface.uv.values[surface.uv.rows][..., 0], corners[..., 0])
    np.testing.assert_allclose(surface.uv.values[surface.uv.rows][..., 1], 1 - corners[..., 1])
    assert load_surface(wooden(tmp_path, "newmtl wood\n", FACES + "f 1 2 3\n")).uv is None


def test_a_real_model_agrees(models):
    path = models / "spot-triangulated" / "spot.obj"
    if not path.is_file():
        pytest.skip("spot is not there")
    assert_agrees(path, 500)


def test_every_real_model_loads_or_says_why_not(models):
    for path in sorted(models.rglob("*.obj")):
        if path.name == "Cray_right.obj":
            with pytest.raises(ModelError, match="vertices are not all finite"):
                load_surface(path)
        elif path.name.startswith("ptex_test_object"):
            with pytest.warns(ModelWarning, match=r"ptex_test_object\.mtl is missing"):
                load_surface(path)
        else:
            assert [form.name for form in load_surface(path).channels] == ["base_color"], path


def test_convex_polygons_become_fans(tmp_path):
    lines = "v 0 0 0\nv 2 0 0\nv 3 1 0\nv 2 2 0\nv 0 2 0\nf 1 2 3 4 5\nf 1 2 4 5\nf 1 2\nf 1\n"
    surface = assert_agrees(obj(tmp_path / "a.obj", lines))
    np.testing.assert_array_equal(surface.triangles, [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 1, 3], [0, 3, 4]])


def crescent(corners):
    """A "C" of so many corners, whose opening is to the right."""
    angles = np.linspace(0.15, 1.85, corners // 2) * np.pi
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return np.concatenate([ring, 0.5 * ring[::-1]])


def shoelace(ring):
    """The area of a polygon without holes."""
    after = np.roll(ring, -1, axis=0)
    return float(abs((ring[:, 0] * after[:, 1] - ring[:, 1] * after[:, 0]).sum()) / 2)


@pytest.mark.parametrize(
    "ring",
    [
        np.array([(0, 0), (3, 0), (3, 1), (1, 1), (1, 3), (0, 3)]),
        np.array([(0, 0), (4, 2), (0, 4), (1, 2)])[::-1],
        np.array([(0, 0), (4, 0), (4, 4), (3, 1), (2, 4), (1, 1), (0, 4)]),
        crescent(514),
        crescent(3000)[::-1],
        # Corners twice; a hole reached by a slit; two parts that touch at a corner; a spike of no area.
        np.array([(0, 0), (3, 0), (3, 1), (1, 1), (1, 1), (1, 1), (1, 3), (0, 3), (0, 3)]),
        np.array([(0, 0), (4, 0), (4, 4), (0, 4), (0, 0), (1, 1), (1, 3), (3, 3), (3, 1), (1, 1)]),
        np.array([(0, 0), (2, 0), (1, 1), (2, 2), (0, 2), (1, 1)]),
        np.array([(0, 0), (3, 0), (3, 3), (5, 5), (3, 3), (0, 3)]),
    ],
    ids=["L", "dart", "crown", "C of 514", "C of 3000", "repeated", "hole", "touching", "spike"],
)
@pytest.mark.parametrize("turned", [0, 1, 2, 3, 4, 5])
def test_a_polygon_of_any_size_and_form_is_covered_once(tmp_path, ring, turned):
    ring = np.roll(ring, turned, axis=0)
    lines = "".join(f"v {x!r} {y!r} {2 * x!r}\n" for x, y in ring.tolist())
    path = obj(tmp_path / "a.obj", lines + "f " + " ".join(str(i + 1) for i in range(len(ring))) + "\n")
    surface = load_surface(path)
    assert len(surface.triangles) == len(ring) - 2
    np.testing.assert_allclose(surface.areas().sum(), shoelace(ring) * 5**0.5, rtol=1e-9)


def test_a_polygon_that_is_not_flat_is_cut_along_its_area_vector(tmp_path):
    angles = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1) * (1 + 0.3 * np.cos(5 * angles))[:, None]
    lines = "".join(f"v {x} {y} {0.1 * np.cos(2 * a)}\n" for (x, y), a in zip(ring, angles, strict=True))
    surface = load_surface(obj(tmp_path / "a.obj", lines + f"f {' '.join(map(str, range(1, 41)))}\n"))
    seen = np.cross(*np.moveaxis(np.diff(surface.vertices[surface.triangles], axis=1), 1, 0))[:, 2] / 2
    assert (seen >= 0).all()
    np.testing.assert_allclose(seen.sum(), shoelace(ring))


def test_large_polygons_that_are_not_finite_are_refused_and_those_that_cross_themselves_cut(tmp_path):
    lines = "v nan 0 0\n" + "".join(f"v {x} {y} 0\n" for x, y in crescent(600))
    with pytest.raises(ModelError, match="not all finite"):
        load_surface(obj(tmp_path / "a.obj", lines + f"f {' '.join(map(str, range(1, 601)))}\n"))
    lines = "v 0 0 0\nv 1 1 0\nv 1 0 0\nv 0 1 0\nv 2 2 0\nf 1 2 3 4\nf 1 2 3 4 5\nf 1 1 1 1 1\n"
    assert len(load_surface(obj(tmp_path / "a.obj", lines)).triangles) == 2 + 3 + 3
