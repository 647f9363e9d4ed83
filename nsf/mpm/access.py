"""Access to a node's four values at once: the transfers are bound by the number of accesses, not by bytes."""

from functools import cache

import warp as wp

from nsf.mpm.precision import FP32, Precision

# One reduction of 16 bytes (compute capability 9.0) in place of four of 4 bytes.
_ADD = """
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
    asm volatile(
        "red.global.add.v4.f32 [%0], {%1, %2, %3, %4};"
        :: "l"(&wp::index(values, slot)), "f"(added[0]), "f"(added[1]), "f"(added[2]), "f"(added[3])
        : "memory"
    );
#else
    wp::atomic_add(values, slot, added);
#endif
"""
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


@cache
def make_add(precision: Precision, deterministic: bool):
    """Warp function (values, slot, added): values[slot] += added, atomically.

    The array starts where an allocation does, so that every entry is aligned.

    Args:
        precision: of the values.
        deterministic: through Warp's own atomic, whose order it can fix.
    """
    vec4 = precision.vec4
    if precision is FP32 and not deterministic:

        @wp.func_native(_ADD)
        def add(values: wp.array(dtype=vec4), slot: int, added: vec4): ...

    else:

        @wp.func
        def add(values: wp.array(dtype=vec4), slot: int, added: vec4):
            wp.atomic_add(values, slot, added)

    return add


@cache
def make_load(precision: Precision):
    """Warp function (values, slot) → values[slot], aligned as for `make_add`."""
    vec4 = precision.vec4

    @wp.func_native(_LOAD_FP32 if precision is FP32 else _LOAD_FP64)
    def load(values: wp.array(dtype=vec4), slot: int) -> vec4: ...

    return load
