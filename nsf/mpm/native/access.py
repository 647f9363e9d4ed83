"""Access to a node's four values at once, and what threads of a GPU share: accesses bind the transfers."""

from functools import cache

import warp as wp

from nsf.mpm.native import native_code
from nsf.mpm.precision import Precision

#: Threads of a GPU that take every step together; where they share work, a launch is over whole warps.
WARP = 32
SHARED = 49152  #: Memory [byte] that threads of a GPU's block share without asking for more.
TAKEN = 4096  #: What Warp takes of it [byte].


@cache
def make_warp_sum(precision: Precision):
    """Warp function (value [3], lanes) → the sum over the lanes of a warp, in each; of one lane its value."""
    vec3 = precision.vec3

    @wp.func_native(native_code("nsf.mpm", "warp_sum", real=precision.native))
    def total(value: vec3, lanes: int) -> vec3: ...

    return total


@cache
def make_load(precision: Precision):
    """Warp function (values, slot) → values[slot]; values start where an allocation does, and are aligned."""
    vec4 = precision.vec4

    @wp.func_native(native_code("nsf.mpm", "load", real=precision.native))
    def load(values: wp.array(dtype=vec4), slot: int) -> vec4: ...

    return load
