"""Build the documentation site: pages of octex/docs, commands, API, file format, gallery.

    python tools/release/docs.py [FOLDER]      writes FOLDER/index.html (default: site); needs octex[docs]

Links and references to objects that lead nowhere are errors.
"""

from __future__ import annotations

import contextlib
import io
import json
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import octex
from octex.cli.main import main
from octex.cli.options import COMMANDS
from octex.docs import GROUPS

ROOT = Path(__file__).parents[2]
TITLES = {"start": "Start", "tasks": "Tasks", "reference": "Reference", "about": "About"}
#: The order in which the API's page lists what octex exports.
API = {
    "Surfaces": "load_surface Surface repair subdivide Creases",
    "Sources": "MappedImage PointCloud Transfer Voxels Ptex",
    "Conversion": "convert convert_set separate",
    "Textures": "open OctreeTexture TextureSet",
    "Painting": "paint project merge fill Painter Layers Projection Box Sphere unwrap Patch refine_cameras",
    "Cameras": "Camera read_cameras write_cameras",
    "Processing": "levels curves map mix combine blur crop resize cast",
    "Images": "render write_preview difference Environment",
    "Baking": "bake bake_vertices finish simplify displace write_model write_ptex write_osl",
    "How to work": "Run",
    "Errors": "OctexError",
}


def said(*words: str) -> str:
    """Return what a command prints."""
    with contextlib.redirect_stdout(io.StringIO()) as output:
        main(words)
    return output.getvalue()


def index() -> str:
    """Return README with links that lead into the site."""
    text = (ROOT / "README.md").read_text("utf-8")
    text = re.sub(r"\(octex/docs/([a-z-]+\.md)\)", r"(\1)", text).replace("(samples/images/", "(images/")
    text = text.replace("(octex/formats/FORMAT.md)", "(format.md)").replace("(images/)", "(gallery.md)")
    return re.sub(r"\[([^\]]+)\]\((?:octex/__init__\.py|tools|samples|samples/images)\)", r"\1", text)


def gallery() -> str:
    """Return a page of all images that the samples draw, with what each script says of itself."""
    lines = ["# Gallery", "", "The scripts of `samples/` draw these images."]
    images = sorted(path.name for path in (ROOT / "samples/images").glob("*.png"))
    for script in sorted([*(ROOT / "samples").glob("[0-9]*.py"), *(ROOT / "samples").glob("draw_*.py")]):
        text = script.read_text("utf-8")
        shown = [name for name in images if f'"{name}"' in text]
        if shown:
            title = text.split('"""')[1].split("\n")[0]
            lines += ["", f"## {title}", "", f"`samples/{script.name}`"]
            lines += [f"\n![{title}](images/{name})" for name in shown]
    return "\n".join(lines)


def build(site: Path) -> None:
    """Write the sources of the site into a folder, and have mkdocs build it."""
    listed = {name for names in API.values() for name in names.split()}
    assert listed == {*octex._HOMES}, f"the API's page and octex differ: {listed ^ {*octex._HOMES}}"
    with tempfile.TemporaryDirectory() as name:
        pages = Path(name) / "docs"
        shutil.copytree(ROOT / "octex/docs", pages, ignore=shutil.ignore_patterns("__*"))
        shutil.copytree(ROOT / "samples/images", pages / "images")
        shutil.copy(ROOT / "octex/formats/FORMAT.md", pages / "format.md")
        commands = [f"## octex {each}\n\n```text\n{said(each, '--help')}```\n" for each in COMMANDS]
        api = [
            f"## {title}\n\n" + "\n".join(f"::: {'.'.join(octex._HOMES[each])}\n" for each in names.split())
            for title, names in API.items()
        ]
        written = {
            "index.md": index(),
            "gallery.md": gallery(),
            "wide.css": ".md-grid { max-width: 75rem; }",
            "commands.md": "\n".join([(pages / "commands.md").read_text("utf-8"), *commands]),
            "api.md": "# Python API\n\n" + "\n".join(api),
        }
        for path, text in written.items():
            (pages / path).write_text(text, "utf-8")
        for page in pages.glob("*.md"):
            page.write_text(page.read_text("utf-8").replace("../../samples/images/", "images/"), "utf-8")
        groups = [
            {title: [f"{page}.md" for page in GROUPS[group].split()]} for group, title in TITLES.items()
        ]
        groups[2]["Reference"] += ["api.md", "format.md"]
        options = {
            "extensions": [str(Path(__file__).with_name("docs_parameters.py"))],
            "heading_level": 3,
            "members_order": "source",
            "separate_signature": True,
            "show_bases": False,
            "show_root_full_path": False,
            "show_root_heading": True,
            "show_signature_annotations": True,
            "line_length": 90,
            "show_source": False,
        }
        config = {
            "site_name": "octex",
            "site_description": "Octree textures for Python: colour a model without UVs",
            "docs_dir": str(pages),
            "site_dir": str(site.resolve()),
            "theme": {
                "name": "material",
                "font": False,
                "features": ["navigation.sections", "content.code.copy"],
            },
            "extra_css": ["wide.css"],
            "markdown_extensions": ["tables", "fenced_code", "pymdownx.highlight", "pymdownx.superfences"],
            "plugins": [
                "search",
                {"mkdocstrings": {"handlers": {"python": {"paths": [str(ROOT)], "options": options}}}},
            ],
            "nav": [{"octex": "index.md"}, *groups, {"Gallery": "gallery.md"}],
            "validation": {"links": {"not_found": "warn", "absolute_links": "warn"}},
        }
        path = Path(name) / "mkdocs.yml"
        path.write_text(json.dumps(config), "utf-8")
        subprocess.run([sys.executable, "-m", "mkdocs", "build", "--strict", "-q", "-f", path], check=True)
    print(site / "index.html")


if __name__ == "__main__":
    build(Path(*sys.argv[1:2] or ["site"]))
