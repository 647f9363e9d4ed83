"""Access to a node's four values at once, and what threads of a GPU share: accesses bind the transfers."""

from functools import cache

import warp as wp

from nsf.mpm.precision import FP32, Precision

_LOAD_FP32 = """
#if defined(__CUDA_ARCH__)
    float4 v = *reinterpret_cast<const float4*>(&wp::index(values, slot));
    return wp::vec_t<4, float>(v.x, v.y, v.z, v.w);
#else
    return wp::index(values, slot);
#endif
"""
_LOAD_FP64 = """
#if defined(__CUDA_ARCH__)
    const double2* at = reinterpret_cast<const double2*>(&wp::index(values, slot));
    double2 v = at[0];
    double2 w = at[1];
    return wp::vec_t<4, double>(v.x, v.y, w.x, w.y);
#else
    return wp::index(values, slot);
#endif
"""
#: Threads of a GPU that take every step together; where they share work, a launch is over whole warps.
WARP = 32
SHARED = 49152  #: Memory [byte] that threads of a GPU's block share without asking for more.
TAKEN = 4096  #: What Warp takes of it [byte].


@cache
def make_warp_sum(precision: Precision):
    """Warp function (value [3], lanes) → the sum over the lanes of a warp, in each; of one lane its value."""
    vec3 = precision.vec3
    snippet = f"""
#if defined(__CUDA_ARCH__)
    wp::vec_t<3, {precision.native}> sum = value;
    if (lanes > 1)
        for (int d = 16; d > 0; d /= 2)
            for (int i = 0; i < 3; ++i) sum[i] += __shfl_xor_sync(0xffffffffu, sum[i], d);
    return sum;
#else
    return value;
#endif
"""

    @wp.func_native(snippet)
    def total(value: vec3, lanes: int) -> vec3: ...

    return total


@cache
def make_load(precision: Precision):
    """Warp function (values, slot) → values[slot]; values start where an allocation does, and are aligned."""
    vec4 = precision.vec4

    @wp.func_native(_LOAD_FP32 if precision is FP32 else _LOAD_FP64)
    def load(values: wp.array(dtype=vec4), slot: int) -> vec4: ...

    return load
