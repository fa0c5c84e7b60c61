"""Compilation: decorators for kernels, and instructions that numba lacks.

With ``NUMBA_DISABLE_JIT=1`` every kernel runs as plain Python; the instructions then have plain twins.

No class or function of numba is changed. Of its undocumented parts, `decorators` passes the option ``_nrt``
and derives the type of functions that kernels call; `instructions` and `vectors` generate code as numba's own
extensions do.

decorators    kernel, part …: compile functions
cache         stores compiled kernels on disk, and checks that they match the source
instructions  bits, memory, arrays
vectors       vectors of numbers; sums of rows of four, boxes eight at a time
"""

from octex.jit.decorators import DISABLED as DISABLED
from octex.jit.decorators import by_constants as by_constants
from octex.jit.decorators import direct as direct
from octex.jit.decorators import fused_inlined as fused_inlined
from octex.jit.decorators import fused_kernel as fused_kernel
from octex.jit.decorators import fused_part as fused_part
from octex.jit.decorators import inlined as inlined
from octex.jit.decorators import kernel as kernel
from octex.jit.decorators import part as part
from octex.jit.decorators import step as step
from octex.jit.decorators import summing_kernel as summing_kernel
from octex.jit.decorators import unlocked as unlocked
from octex.jit.instructions import decoded as decoded
from octex.jit.instructions import popcount as popcount
from octex.jit.instructions import prefetch as prefetch
from octex.jit.instructions import trailing_zeros as trailing_zeros
from octex.jit.vectors import add_to_rows as add_to_rows
from octex.jit.vectors import chosen as chosen
from octex.jit.vectors import mask_bits as mask_bits
from octex.jit.vectors import put as put
from octex.jit.vectors import refine_rows as refine_rows
from octex.jit.vectors import sixteen as sixteen
from octex.jit.vectors import sixteen_at as sixteen_at
from octex.jit.vectors import spline_at_eight as spline_at_eight
from octex.jit.vectors import spline_box as spline_box
from octex.jit.vectors import squares_to_boxes as squares_to_boxes
from octex.jit.vectors import weighted_rows as weighted_rows
