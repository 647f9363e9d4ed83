"""Access to a node's four values at once, and for many particles: accesses, not bytes, bind the transfers."""

from functools import cache

import warp as wp

from nsf.mpm.precision import FP32, Precision

# One reduction of 16 bytes (compute capability 9.0) in place of four of 4 bytes.
_ADD_FP32 = """
    if (turns == 0 || slot < 0) return;
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
# There is none of 32 bytes: four lanes take one value each, so that they are one access to memory.
_ADD_FP64 = """
#if defined(__CUDA_ARCH__)
    const unsigned all = 0xffffffffu;
    int own = threadIdx.x & 3;
    for (int turn = 0; turn < 4; ++turn) {
        unsigned from = (static_cast<unsigned>(turns) >> (8 * turn)) & 0xffu;
        if (!__any_sync(all, from != 0xffu)) return;
        double a = __shfl_sync(all, added[0], from & 31u);
        double b = __shfl_sync(all, added[1], from & 31u);
        double c = __shfl_sync(all, added[2], from & 31u);
        double d = __shfl_sync(all, added[3], from & 31u);
        int at = __shfl_sync(all, slot, from & 31u);
        if (from == 0xffu || at < 0) continue;
        double one = own == 0 ? a : own == 1 ? b : own == 2 ? c : d;
        atomicAdd(reinterpret_cast<double*>(&wp::index(values, at)) + own, one);
    }
#else
    if (turns && slot >= 0) wp::atomic_add(values, slot, added);
#endif
"""
_TURNS_FP64 = """
#if defined(__CUDA_ARCH__)
    unsigned found = 0xffffffffu;
    int group = (threadIdx.x & 31) >> 2, rank = 0;
    for (unsigned left = __ballot_sync(0xffffffffu, adds); left; left &= left - 1, ++rank)
        if ((rank & 7) == group)
            found ^= (0xffu ^ static_cast<unsigned>(__ffs(left) - 1)) << (8 * (rank >> 3));
    return static_cast<int>(found);
#else
    return adds;
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
# All 32 lanes of a warp take part in what follows.
_RUN = """
#if defined(__CUDA_ARCH__)
    if (__all_sync(0xffffffffu, key < 0)) return 0;
    const unsigned all = 0xffffffffu;
    int lane = threadIdx.x & 31;
    int before = __shfl_up_sync(all, key, 1);
    bool first = lane == 0 || before != key;
    unsigned others = __ballot_sync(all, first);
    unsigned after = lane == 31 ? 0u : others >> (lane + 1);
    int left = after ? __ffs(after) : 32 - lane;
    int longest = left;
#if __CUDA_ARCH__ >= 800
    longest = __reduce_max_sync(all, left);
#else
    for (int offset = 16; offset > 0; offset /= 2)
        longest = max(longest, __shfl_xor_sync(all, longest, offset));
#endif
    return (first ? 1 : -1) * (left + 64 * longest);
#else
    return key < 0 ? 0 : 1;
#endif
"""
_SUM = """
#if defined(__CUDA_ARCH__)
    const unsigned all = 0xffffffffu;
    const int left = abs(run) % 64, longest = abs(run) / 64;
    wp::vec_t<4, {real}> sum = value;
    for (int offset = 1; offset < longest; offset *= 2) {{
        {real} a = __shfl_down_sync(all, sum[0], offset);
        {real} b = __shfl_down_sync(all, sum[1], offset);
        {real} c = __shfl_down_sync(all, sum[2], offset);
        {real} d = __shfl_down_sync(all, sum[3], offset);
        if (offset < left) {{
            sum[0] += a;
            sum[1] += b;
            sum[2] += c;
            sum[3] += d;
        }}
    }}
    return sum;
#else
    return value;
#endif
"""
#: Threads that take every step together; a kernel with sums is launched over whole warps.
WARP = 32


@wp.func
def whole_warps(threads: int):
    """Threads of so many whole warps as these threads need."""
    return (threads + 31) / 32 * 32


@cache
def make_sum(precision: Precision, deterministic: bool):
    """Warp functions (run_of, sum) that add up values of neighbouring threads of a warp with the same key.

    run_of: key → number of threads from this one to the last of those in a row that have its key, plus 64
    times the most of any thread of the warp; negative where the thread before has it too; 0 where no thread
    of the warp has a key ≥ 0, so that all may leave.
    sum: (value, run) → the sum over these threads, of which the first, whose run is positive, alone counts.
    On a CPU, or if deterministic, every thread is alone.

    Args:
        precision: of the values.
        deterministic: see above.
    """
    vec4 = precision.vec4
    if deterministic:

        @wp.func
        def run_of(key: int):
            return wp.where(key < 0, 0, 1)

        @wp.func
        def total(value: vec4, run: int):
            return value

    else:

        @wp.func_native(_RUN)
        def run_of(key: int) -> int: ...

        @wp.func_native(_SUM.format(real=precision.native))
        def total(value: vec4, run: int) -> vec4: ...

    return run_of, total


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
def make_add(precision: Precision, deterministic: bool):
    """Warp functions (turns_of, add) that add to a node's values, atomically.

    turns_of: whether this thread has something to add → its part in the warp's additions, for `add`: in fp64
    on a GPU the lane whose values it helps to add, turn by turn, a byte each (255: none); else 1 or 0.
    add: (values, slot, added, turns): values[slot] += added; nothing where slot is negative. On a GPU all
    threads of a warp call both together.

    The array starts where an allocation does, so that every entry is aligned.

    Args:
        precision: of the values.
        deterministic: through Warp's own atomic, whose order it can fix.
    """
    vec4 = precision.vec4
    if deterministic or precision is FP32:

        @wp.func
        def turns_of(adds: bool):
            return wp.where(adds, 1, 0)

    else:

        @wp.func_native(_TURNS_FP64)
        def turns_of(adds: bool) -> int: ...

    if deterministic:

        @wp.func
        def add(values: wp.array(dtype=vec4), slot: int, added: vec4, turns: int):
            if turns > 0 and slot >= 0:
                wp.atomic_add(values, slot, added)

    else:

        @wp.func_native(_ADD_FP32 if precision is FP32 else _ADD_FP64)
        def add(values: wp.array(dtype=vec4), slot: int, added: vec4, turns: int): ...

    return turns_of, add


@cache
def make_load(precision: Precision):
    """Warp function (values, slot) → values[slot], aligned as for `make_add`."""
    vec4 = precision.vec4

    @wp.func_native(_LOAD_FP32 if precision is FP32 else _LOAD_FP64)
    def load(values: wp.array(dtype=vec4), slot: int) -> vec4: ...

    return load
