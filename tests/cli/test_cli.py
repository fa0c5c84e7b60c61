"""octree-convert as a stranger meets it: usage, help, and as a process."""

import ast
import importlib
import inspect
import os
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest

import octex
from octex import ahead
from octex.cli.options import COMMANDS, OPTIONS
from octex.cli.parser import Parser
from octex.cli.values import DTYPES, FILTERS, depth, image_size
from octex.errors import ArgumentError, ExitCode
from tests.conftest import fewer_points, needs_jit
from tests.make.command import python
from tests.make.fixtures import OBJ_SQUARE, obj, png, random_image, textured_square


def parsed(*words, command="convert"):
    return Parser(f"octex {command}", COMMANDS[command], COMMANDS).parsed(words)


TOOLS = Path(__file__).parents[2] / "tools" / "release"
HEAVY = [
    "numpy", "numba", "PIL", "trimesh", "manifold3d", "tqdm", "octex.texture", "octex.tree",
    "octex.painting",
]  # fmt: skip
#: Commands that read and write nothing, and their exit codes.
IDLE = {
    "convert --help": 0, "convert model.glb nowhere/model.octex": 2, "paint --help": 0, "paint --version": 0,
    "paint a.glb b.octex": 2, "--help": 0, "help painting": 0, "x": 2,
}  # fmt: skip


def test_the_help_lists_the_types_and_filters_of_the_library():
    from octex.channels import ONE
    from octex.source.images.filters import FILTERS as KNOWN
    from octex.tree.layout import MAX_DEPTH

    assert depth(str(MAX_DEPTH)) == MAX_DEPTH
    with pytest.raises(ArgumentError, match=f"is not from 0 to {MAX_DEPTH}"):
        depth(str(MAX_DEPTH + 1))
    assert tuple(ONE) == DTYPES
    assert KNOWN == FILTERS
    assert f"{KNOWN[-1]} (default)" in OPTIONS["--filter"].help


@pytest.mark.parametrize(
    ("word", "text", "meaning"),
    [
        ("source", "roughness=0.5", [("roughness", 0.5)]),
        ("source", "base_color = 0.2,0.4, 0.6", [("base_color", (0.2, 0.4, 0.6))]),
        ("source", "base_color=#ff8000", [("base_color", "#ff8000")]),
        ("source", "base_color=#1.png", [("base_color", Path("#1.png"))]),
        ("source", "alpha=a b.png", [("alpha", Path("a b.png"))]),
        ("source", "alpha=folder=x/0.5.png", [("alpha", Path("folder=x/0.5.png"))]),
        ("dtype", "uint16", "uint16"),
        ("dtype", "normal=uint16, emissive=float16", {"normal": "uint16", "emissive": "float16"}),
        ("grid", "-1,0,0,1,1,1,0.1", (-1, 0, 0, 1, 1, 1, 0.1)),
        ("project", "box:axis=-y", {"kind": "box", "axis": "-y"}),
    ],
)
def test_values_of_options_are_read(word, text, meaning):
    assert getattr(parsed("a", "b", f"--{word}", text), word) == meaning


def test_help_pages_and_refusals_import_nothing_heavy():
    code = f"""
import sys
from octex.cli import start
from octex.cli.main import main
codes = [int(main(words.split())) for words in {list(IDLE)}]
print(codes, [name for name in {HEAVY} if name in sys.modules])
"""
    done = python(code)
    assert done.stdout.splitlines()[-1] == f"{list(IDLE.values())} []"
    lines = done.stderr.splitlines()
    assert len(lines) == 3
    assert lines[1] == (
        "octex paint: error: --camera is missing: give the file with the cameras; see octex help cameras"
    )


@needs_jit
def test_warming_up_compiles_what_is_listed_and_says_how_long_it_took(cli, monkeypatch):
    done = []
    monkeypatch.setattr("octex.ahead._compile", done.append)
    assert re.fullmatch(r"compiled and cached in \d+\.\d s\n", cli.result("warm-up"))
    assert done == ahead.lines(*ahead.SECTIONS)
    assert cli.result("warm-up", "--quiet") == ""


@pytest.fixture(scope="module")
def called():
    """What Python calls kernels with along every path."""
    from octex.field import lookups

    with pytest.MonkeyPatch.context() as changed:
        changed.syspath_prepend(str(TOOLS))
        changed.setattr(lookups, "_look_up_tiled", lookups.look_up_tiled)  # which is called without recording
        import every_path
        import signatures

        fewer_points(changed, 10)
        with signatures.recorded() as found:
            assert every_path.main([]) == 0
    return set(found)


@needs_jit
def test_all_that_kernels_are_called_with_is_listed(called):
    # Where this fails, `python tools/release/signatures.py` lists anew.
    assert sorted(called - set(ahead.lines(*ahead.SECTIONS))) == []


@needs_jit
def test_every_kernel_that_is_called_from_python_lies_on_a_path(called):
    decorators = {"kernel", "inlined", "step", "part"}
    decorators |= {"fused_part", "fused_inlined", "summing_kernel", "fused_kernel"}
    entries = {}
    for found in pkgutil.walk_packages(octex.__path__, "octex."):
        module = importlib.import_module(found.name)
        for node in ast.walk(ast.parse(inspect.getsource(module))):
            if isinstance(node, ast.FunctionDef) and not decorators & {
                getattr(decorator, "id", "") for decorator in node.decorator_list
            }:
                names = [inner for inner in ast.walk(node) if isinstance(inner, ast.Name)]
                words = {name.id for name in names} - {
                    name.id for name in names if isinstance(name.ctx, ast.Store)
                }
                kernels = [getattr(getattr(module, word, None), "py_func", None) for word in words]
                entries |= {each: f"{each.__module__}:{each.__qualname__}" for each in kernels if each}
    assert len(entries) > 20
    assert set(entries.values()) - {line.split(" ", 1)[0] for line in called} == set()


# --- the order of arguments


@pytest.mark.parametrize(
    "arguments",
    [
        "t.octex m.glb n.octex a.png b.png --camera c.json --mask m.png --balance full",
        "--camera c.json t.octex --balance full m.glb n.octex a.png --mask m.png b.png",
        "t.octex --mask m.png m.glb n.octex a.png --camera c.json --balance full b.png",
        "--balance=full --mask m.png --camera=c.json -- t.octex m.glb n.octex a.png b.png",
    ],
)
def test_options_may_stand_anywhere(arguments):
    given = vars(parsed(*arguments.split(), command="paint"))
    assert sorted(given.pop("words")) == ["--balance", "--camera", "--mask"]
    usual = {each.name: each.default for each in OPTIONS.values()}
    assert {name: value for name, value in given.items() if value and value != usual.get(name)} == {
        "MODEL": Path("m.glb"),
        "TEXTURE": Path("t.octex"),
        "IMAGE": [Path("a.png"), Path("b.png")],
        "camera": (Path("c.json"), None),
        "OUTPUT": Path("n.octex"),
        "mask": [Path("m.png")],
        "balance": "full",
    }


def test_help_tells_the_default_that_holds():
    for option in OPTIONS.values():
        text = option.default
        if isinstance(text, (int, float)):
            text = f"{text:g}"
        elif option.word == "--up":
            text = ",".join(f"{number:g}" for number in text)
        if isinstance(text, str) and option.word not in ("--loss", "--port"):
            assert f"{text} (default)" in option.help or f"(default {text}" in option.help, option.word


def test_sizes_have_a_comma_or_an_x_and_options_may_stand_twice_and_anywhere():
    assert {image_size(text) for text in ("640,480", "640x480", "640×480")} == {(640, 480)}
    options = parsed("--source", "alpha=1", "a", "--source", "roughness=0", "--json", "--", "-b")
    assert [name for name, _ in options.source] == ["alpha", "roughness"]
    assert (options.json, options.INPUT, options.OUTPUT) == (True, Path("a"), Path("-b"))


# --- warnings


def test_a_warning_is_a_line_on_stderr(tmp_path, cli):
    model = obj(tmp_path / "a.obj", "mtllib gone.mtl\n" + OBJ_SQUARE + "usemtl wood\nf 1 2 3\nf 1 3 4\n")
    given = model, tmp_path / "a.octex", "--depth", 3, "--force"
    assert cli.errors(*given, "--quiet") == ""
    for more in ([], ["--source", "base_color=1,0,0"]):
        warnings = [line for line in cli.errors(*given, *more).splitlines() if "warning" in line]
        assert warnings == [
            "octree-convert: warning: a.obj: gone.mtl is missing, so the material wood is white; "
            "put it next to the model"
        ]


# --- as a process

PROCESS = "import sys; from octex.cli.main import main; sys.exit(main())"
posix = pytest.mark.skipif(sys.platform == "win32", reason="signals, limits and devices of POSIX")


#: What happens to a conversion, the code that makes it happen, and what it ends with then.
ENDINGS = {
    "the disk is full": (
        """
import resource
class Other(convert.Reporter):
    def __call__(self, stage, done, total):
        if stage == "write":
            resource.setrlimit(resource.RLIMIT_FSIZE, (3000, 3000))
convert.Reporter = Other
""", ExitCode.REFUSED, "octree-convert: error: {out}: cannot be written: File too large; make room.*",
    ),
    "it is interrupted": (
        """
# A job in the background inherits that it is ignored.
signal.signal(signal.SIGINT, signal.default_int_handler)
class Other(convert.Reporter):
    def __call__(self, stage, done, total):
        super().__call__(stage, done, total)
        if stage == "convert":
            os.kill(os.getpid(), signal.SIGINT)
convert.Reporter = Other
""", ExitCode.INTERRUPTED, "octree-convert: interrupted",
    ),
    "it is told to end": (
        """
signal.signal(signal.SIGTERM, signal.SIG_DFL)
files._nameless_file = lambda folder: None
sync = os.fsync
def end(file):
    os.kill(os.getpid(), signal.SIGTERM)
    sync(file)
os.fsync = end
""", ExitCode.TERMINATED, "octree-convert: ended by SIGTERM",
    ),
}  # fmt: skip


@posix
@pytest.mark.parametrize("what", ENDINGS)
def test_a_conversion_that_fails_says_so_in_a_line_and_leaves_the_old_file(what, model, tmp_path):
    changes, code, line = ENDINGS[what]
    out = tmp_path / "box.octex"
    out.write_bytes(b"old")
    before = "import os, signal, sys\nfrom octex import files\nfrom octex.cli import convert\n"
    after = "\nfrom octex.cli.start import octree_convert\nsys.exit(octree_convert())\n"
    done = python(before + changes + after, str(model), str(out), "--depth", "3", "--force")
    assert done.returncode == code, done.stderr
    *lines, last = done.stderr.splitlines()
    assert re.fullmatch(line.format(out=re.escape(str(out))), last)
    assert not lines or code != ExitCode.REFUSED
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"old"]


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="this system does not count threads there")
def test_no_more_threads_are_started_than_asked_for(tmp_path):
    watching = """
import re, sys, threading
from pathlib import Path
from octex.cli.main import main

most, ended = 0, threading.Event()

def watch():
    global most
    while not ended.wait(0.001):
        most = max(most, int(re.search("Threads:\\s*(\\d+)", Path("/proc/self/status").read_text())[1]))

watcher = threading.Thread(target=watch)
watcher.start()
for count in (1, 2):
    most = 0
    code = main(["convert", *sys.argv[1:], "--threads", str(count)])
    print(code, most - 2)  # but for this one and the watcher
ended.set()
watcher.join()
"""
    model = textured_square(tmp_path / "a.glb", png(random_image(64, 64)))
    done = python(watching, str(model), str(tmp_path / "a.octex"), "--depth", "4", "--quiet", "--force")
    found = [[int(word) for word in line.split()] for line in done.stdout.splitlines()]
    assert [code for code, _ in found] == [ExitCode.DONE] * 2, done.stderr
    assert [most <= count for count, (_, most) in enumerate(found, 1)] == [True] * 2, found


@posix
def test_a_broken_pipe_is_harmless_and_a_full_device_is_not(made):
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "wb") as broken:
        arguments = [sys.executable, "-c", PROCESS, "info", str(made)]
        done = subprocess.run(arguments, stdout=broken, stderr=subprocess.PIPE, text=True, timeout=600)
    assert (done.returncode, done.stderr) == (ExitCode.DONE, "")
    if Path("/dev/full").exists():
        with Path("/dev/full").open("wb") as full:
            done = subprocess.run(arguments, stdout=full, stderr=subprocess.PIPE, text=True, timeout=600)
        assert done.returncode == ExitCode.REFUSED
        assert done.stderr == (
            "octex info: error: standard output cannot be written: No space left on device\n"
        )


@posix
def test_a_link_that_leads_to_itself_is_no_output(model, tmp_path, cli):
    loop, other = tmp_path / "loop.octex", tmp_path / "other.octex"
    loop.symlink_to(loop)
    for force in ([], ["--force"]):
        said = cli.refusal(model, loop, "--depth", "3", *force)
        assert f"{loop}: is a symbolic link to itself" in said
    other.symlink_to(tmp_path / "target.octex")  # one that leads to nothing yet is a name as any
    cli.result(model, other, "--depth", "3", "--quiet")
    assert other.is_symlink() and (tmp_path / "target.octex").is_file()
    texture = octex.open(other)
    for write in (texture.save, lambda path: octex.write_cameras(path, {})):
        with pytest.raises(octex.OctexError, match="is not a file that can be replaced"):
            write(loop)
    assert loop.is_symlink()
