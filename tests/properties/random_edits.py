"""Random sequences of edits of small textures, each a script that a person can run.

A step is lines of Python, and claims of what has become of the texture. What fails is told as the shortest
script found that fails alike.
"""

import re
import traceback
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest import mock

import numpy as np

from tests.properties import edit_changes as changes
from tests.properties import edit_paints as paints
from tests.properties.edit_models import DTYPES, vars_of_scripts
from tests.properties.edit_run import Run

#: Larger textures take too long to be looked at after every step.
MOST_CELLS = 40_000

#: What is large there is small here: pixels around a stroke's paint, cells that are merged at once, and how
#: much the pieces may have in common.
SMALL = (
    ("octex.painting.paint.AROUND", 8),
    ("octex.painting.merge.WHOLE", 500),
    ("octex.painting.merge.PIECE", 500),
    ("octex.painting.merge.MOST", 1000.0),
)

STEPS = (
    (paints.draw_fill, 6), (paints.draw_fill_all, 1), (paints.draw_paint, 4), (paints.draw_session, 2),
    (paints.draw_layers, 2), (paints.draw_layer, 2), (paints.draw_again, 1), (changes.draw_map, 2),
    (changes.draw_levels, 1), (changes.draw_mix, 3), (changes.draw_combine, 2), (changes.draw_blur, 2),
    (changes.draw_crop, 2), (changes.draw_resize, 2), (changes.draw_cast, 2), (changes.draw_level, 1),
    (changes.draw_curves, 1), (changes.draw_reopened, 1),
)  # fmt: skip
LARGE = paints.draw_paint, paints.draw_session, paints.draw_layers, paints.draw_layer, paints.draw_again
LARGE += changes.draw_mix, changes.draw_combine, changes.draw_curves, changes.draw_reopened
SMALL_STEPS = tuple(pair for pair in STEPS if pair[0] not in LARGE)


@contextmanager
def small_sizes():
    """Have small what is in SMALL until the end of the block."""
    with ExitStack() as patches:
        for name, value in SMALL:
            patches.enter_context(mock.patch(name, value))
        yield


def check(seed, dtypes=DTYPES, *, small=False, shrinks=True):
    """Do a random sequence of edits; raise AssertionError, with a script that repeats it, for what fails.

    ``small`` ones are of few cells and without images.
    """
    with TemporaryDirectory(prefix="octex-edits-") as folder, small_sizes():
        run = Run(dtypes, Path(folder), 16 if small else 120)
        try:
            _drawn(np.random.default_rng(seed), run, small)
            return
        except Exception as error:
            failed = error
        steps = _shrunk(run, failed) if shrinks else run.steps
        lines = [f"from tests.properties.edit_models import {', '.join(sorted(vars_of_scripts()))}"]
        lines += [f"import {name.rpartition('.')[0]}; {name} = {value}" for name, value in SMALL]
        script = "\n".join(lines + [line for step in steps for line in step.lines])
        where = _where(failed)
    raise AssertionError(f"edits, seed {seed}: {failed}\n{where}\n\n{script}") from failed


def _drawn(random, run, small):
    steps = SMALL_STEPS if small else STEPS
    draws, shares = [draw for draw, _ in steps], np.array([share for _, share in steps], float)
    for step in paints.first_steps(random, run, small):
        if not run.take(step):
            return
    for _ in range(int(random.integers(1, 4 if small else 7))):
        if not 1 <= run.texture.tree.n_leaves <= MOST_CELLS:
            return
        run.take(draws[random.choice(len(draws), p=shares / shares.sum())](random, run))


def kind_of(error):
    """What an error is, without its numbers: the same for those that have one cause."""
    return f"{type(error).__name__} {re.sub(r'[-+.]*[0-9][-+.e0-9]*', '#', str(error))[:50]}"


def _where(error):
    """The place in octex, or else in the tests, where an error was raised."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [each for each in frames if "/octex/" in each.filename.replace("\\", "/")] or frames
    return f"{type(error).__name__} at {Path(own[-1].filename).name}:{own[-1].name}"


def _fails(steps, run, kind):
    again = Run(run.dtypes, run.folder, run.points)
    try:
        for step in steps:
            if not again.take(step):
                return False
    except Exception as error:
        return kind_of(error) == kind
    return False


def _shrunk(run, error):
    """Leave out steps as long as the rest fails alike."""
    steps, kind = list(run.steps), kind_of(error)
    at = len(steps) - 2
    while at > 0:
        fewer = steps[:at] + steps[at + 1 :]
        if _fails(fewer, run, kind):
            steps = fewer
        at -= 1
    return steps
