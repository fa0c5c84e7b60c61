"""A few random sequences of edits, and that what fails is told. tools/fuzz/soak.py runs them for an hour."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import octex
from tests.conftest import needs_jit
from tests.properties import edit_changes, random_edits
from tests.properties.random_edits import check

TOOL = Path(__file__).parents[2] / "tools" / "fuzz" / "soak.py"
#: What other tests compile too.
DTYPES = ("uint8", "float32")


@needs_jit
@pytest.mark.parametrize("seed", [*range(8), 772959, 9900198, 20261135])
def test_whatever_is_done_to_a_texture_it_stays_sound(seed):
    check(seed, DTYPES)


@pytest.mark.parametrize("seed", range(2))
def test_whatever_is_done_to_a_tiny_texture_it_stays_sound(seed):
    check(seed, DTYPES[:1], small=True)


@needs_jit
def test_a_fault_is_told_as_the_shortest_script_that_has_it(monkeypatch):
    def broken(texture, depth):
        made = texture.level(depth)
        values = made.channels["base_color"].values  # a view of the texture that was given
        values.flags.writeable = True
        values[0] ^= 1
        return made

    def draw(random, run):
        draws = edit_changes.draw_cast, edit_changes.draw_cast, edit_changes.draw_resize
        return draws[min(len(run.steps) - 1, 2)](random, run)

    monkeypatch.setattr(octex, "resize", broken)
    monkeypatch.setattr(random_edits, "SMALL_STEPS", ((draw, 1),))
    with pytest.raises(AssertionError, match="the texture that was given has changed") as told:
        for seed in range(20):  # some do fewer steps
            check(seed, DTYPES[:1], small=True)
    script = str(told.value).partition("\n\n")[2].splitlines()
    assert script[0].startswith("from tests.properties.edit_models import ")
    assert all(f"{name} = {value}" in script[1 + n] for n, (name, value) in enumerate(random_edits.SMALL))
    assert [line.partition("(")[0] for line in script[1 + len(random_edits.SMALL) :]] == [
        "surface = waved",
        "texture = octex.convert",
        "texture = octex.resize",
    ]
    assert f"edits, seed {seed}: " in str(told.value)
    monkeypatch.undo()
    with random_edits.small_sizes():
        exec("\n".join(script), {})


# --- the tool


def soak(folder, *arguments):
    """Run a copy of the tool beside random tests of its own."""
    tool, tests = folder / "tools" / "fuzz" / "soak.py", folder / "tests" / "properties"
    tool.parent.mkdir(parents=True, exist_ok=True)
    tests.mkdir(parents=True, exist_ok=True)
    tool.write_text(TOOL.read_text(encoding="utf-8"), encoding="utf-8")
    for package in (tests.parent, tests):
        (package / "__init__.py").touch()
    (tests / "random_odd.py").write_text(
        "import os, time\n"
        "def check(seed):\n"
        "    print('said by the way')\n"
        "    if seed % 4 == 1:\n"
        "        raise AssertionError(f'seed {seed} is odd')\n"
        "    if seed == 2:\n"
        "        os.abort()\n"
        "    if seed == 4:\n"
        "        time.sleep(60)\n"
        "    if seed == 6:\n"
        "        bytearray(2 << 30)\n",
        encoding="utf-8",
    )
    done = subprocess.run([sys.executable, tool, *arguments], capture_output=True, text=True, check=False)
    return done.returncode, done.stdout + done.stderr


def test_crashes_hangs_and_failures_are_survived_and_grouped(tmp_path):
    code, said = soak(tmp_path, "--seeds", "10", "--limit", "2", "--memory", "0.5")
    assert code == 1
    groups = re.findall(r"^ +\d+  (.+)\n +seeds (.+)$", said, re.MULTILINE)
    assert {group: sorted(map(int, seeds.split(", "))) for group, seeds in groups} == {
        "AssertionError in random_odd.py:check: seed # is odd": [1, 5, 9],
        "CRASH: SIGABRT": [2],
        "HANG: took longer than 2 s": [4],
        "MemoryError in random_odd.py:check: ": [6],
    }
    assert said.count("is odd") == 3  # once as it is met: the group and what was said; once at the end
    assert "python tools/fuzz/soak.py odd --seed 2 --seeds 1" in said
    assert "odd: 10 seeds, 6 failed in 4 ways" in said


def test_what_holds_ends_with_0_and_the_time_with_the_minutes(tmp_path):
    assert soak(tmp_path, "odd", "--seed", "12", "--seeds", "1")[0] == 0
    assert soak(tmp_path, "odd", "--minutes", "0") == (0, "\n")
    code, said = soak(tmp_path, "even")
    assert code == 2
    assert "there is no random_even.py; there are odd" in said
