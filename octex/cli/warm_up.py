"""octex warm-up: compile everything now, so that later commands start at once."""

from __future__ import annotations

import time

from octex.ahead import SECTIONS, ahead, compile_listed
from octex.cli.common import Reporter, say
from octex.cli.parser import Options
from octex.errors import ExitCode


def warm_up(options: Options, program: str) -> int:
    """Run octex warm-up."""
    with Reporter(program, options.quiet, announce=False) as progress, ahead(*SECTIONS):
        compile_listed(progress)
    if not options.quiet:
        say(f"compiled and cached in {time.perf_counter() - options.began:.1f} s")
    return ExitCode.DONE
