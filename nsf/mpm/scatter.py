"""Adds what particles carry to the nodes of a GPU's grid: a thread a node, for the particles of a warp."""

from functools import cache

import warp as wp

from nsf.mpm.access import WARP
from nsf.mpm.precision import FP32, Precision

#: Threads of a block, whose shared memory holds what each of its particles carries.
THREADS = 64
_FEWEST, _WARPS = 8, 2**14  # particles of a warp; warps that keep a GPU busy

_SCATTER = """
#if defined(__CUDA_ARCH__)
    typedef {real} real;
    const int WIDTH = {width}, NODES = WIDTH * WIDTH * WIDTH;
    struct alignas(2 * sizeof(real)) weight_t {{ real value, slope; }};
    struct alignas(16) four_t {{ real of[4]; }};
    struct particle_t {{
        weight_t weights[3][WIDTH];
        four_t affine[3], impulse[3];  // rows; beside them the momentum at the first node, and the mass
        {padding}
    }};
    __shared__ particle_t carried[{warps}][32];
    __shared__ int cells[{warps}][32], starts[{warps}][32];
    const unsigned all = 0xffffffffu;
    const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
    const unsigned live = __ballot_sync(all, cell >= 0);
    // Where another cell or another simulation begins.
    const int before = __shfl_up_sync(all, cell, 1), start_before = __shfl_up_sync(all, start, 1);
    const bool another = lane == 0 || before != cell || start_before != start;
    const unsigned heads = __ballot_sync(all, cell >= 0 && another);
    if (cell >= 0) {{
        particle_t& own = carried[warp][lane];
        for (int axis = 0; axis < 3; ++axis)
            for (int j = 0; j < WIDTH; ++j) own.weights[axis][j] = {{w.data[axis][j], d.data[axis][j]}};
        for (int i = 0; i < 3; ++i) {{
            own.affine[i] = {{affine.data[i][0], affine.data[i][1], affine.data[i][2], momentum[i]}};
            own.impulse[i] = {{impulse.data[i][0], impulse.data[i][1], impulse.data[i][2], mass}};
        }}
        cells[warp][lane] = cell;
        starts[warp][lane] = start;
    }}
    __syncwarp();
    for (int turn = 0; turn < NODES; turn += 32) {{
        const bool has_node = turn + lane < NODES;
        const int node = wp::min(turn + lane, NODES - 1);
        const int a = node / (WIDTH * WIDTH), b = node / WIDTH % WIDTH, c = node % WIDTH;
        const int offset = (a * shape[1] + b) * shape[2] + c;
        const real n_x = real(a), n_y = real(b), n_z = real(c);
        auto stored = [&](int p) {{
            const int flat = cells[warp][p] + offset, at = slots.shape[0] > 0 ? slots.data[flat] : flat;
            return has_node && at >= 0 ? starts[warp][p] + at : -1;
        }};
        real sum[4] = {{}};
        int first = __ffs(heads) - 1, place = stored(first);
        #pragma unroll 1
        for (unsigned left = heads & (heads - 1);; left &= left - 1) {{
            // Looked up while this run is added up.
            const int next = left ? __ffs(left) - 1 : first, place_of_next = stored(next);
            const unsigned after = (heads | ~live) & ~(all >> (31 - first));
            const int end = after ? __ffs(after) - 1 : 32;
            #pragma unroll 2
            for (int p = first; p < end; ++p) {{
                const particle_t& at = carried[warp][p];
                const weight_t x = at.weights[0][a], y = at.weights[1][b], z = at.weights[2][c];
                const real plane = x.value * y.value, weight = plane * z.value;
                const real s_x = x.slope * y.value * z.value, s_y = x.value * y.slope * z.value;
                for (int i = 0; i < 3; ++i) {{
                    const four_t m = at.affine[i], f = at.impulse[i];
                    sum[i] += weight * (m.of[3] + m.of[0] * n_x + m.of[1] * n_y + m.of[2] * n_z);
                    sum[i] += f.of[0] * s_x + f.of[1] * s_y + f.of[2] * (plane * z.slope);
                }}
                sum[3] += weight * at.impulse[0].of[3];
            }}
            // The next cell along the last axis has every node of this one but the first of each column. It
            // is in the same row: no stencil begins where it would reach over a row's end.
            const bool goes_on =
                cells[warp][next] == cells[warp][first] + 1 && starts[warp][next] == starts[warp][first];
            const int slot = goes_on && c > 0 ? -1 : place;
            {add}
            if (!left) break;
            for (int i = 0; i < 4; ++i) {{
                const real handed_on = __shfl_down_sync(all, sum[i], 1);
                sum[i] = goes_on && c < WIDTH - 1 ? handed_on : real(0);
            }}
            first = next;
            place = place_of_next;
        }}
    }}
#endif
"""
# One reduction of 16 bytes (compute capability 9.0) in place of four of 4 bytes.
_ADD_FP32 = """
#if __CUDA_ARCH__ >= 900
            if (slot >= 0)
                asm volatile(
                    "red.global.add.v4.f32 [%0], {%1, %2, %3, %4};"
                    :: "l"(&wp::index(values, slot)), "f"(sum[0]), "f"(sum[1]), "f"(sum[2]), "f"(sum[3])
                    : "memory"
                );
#else
            const wp::vec_t<4, real> added(sum[0], sum[1], sum[2], sum[3]);
            if (slot >= 0) wp::atomic_add(values, slot, added);
#endif
"""
# There is none of 32 bytes: four threads take one value each, so that they are one access to memory.
_ADD_FP64 = """
            __shared__ double sums[{warps}][32][4];
            for (int i = 0; i < 4; ++i) sums[warp][lane][i] = sum[i];
            __syncwarp();
            const int stride = goes_on ? WIDTH : 1;  // the first nodes of columns, or all
            for (int n = 0; n < 32; n += 8 * stride) {{
                const int giver = n + lane / 4 * stride, at = __shfl_sync(all, slot, giver % 32);
                if (giver < 32 && at >= 0)
                    atomicAdd((double*)&wp::index(values, at) + lane % 4, sums[warp][giver][lane % 4]);
            }}
            __syncwarp();
"""


def particles_of_warp(particles: int) -> int:
    """How many particles each warp has: the fewer, the sooner it is done; and the more of a cell, the better.

    Args:
        particles: of all warps.
    """
    each = WARP
    while each > _FEWEST and particles <= each // 2 * _WARPS:
        each //= 2
    return each


@cache
def make_scatter(precision: Precision, width: int):
    """Warp function of what the particles of a warp give to the nodes of their stencils.

    All threads of a warp call it, each with a particle and the flat index of its cell, the first node of the
    stencil, or −1 without one. A thread then takes a node, and adds up what particles of one cell that follow
    each other give it. Where the next cell along the last axis follows, the sum is handed on to the thread
    that has the node there; else it is added to memory. Node (i, j, k) of the stencil gets w_ip m_p [kg] and
    w_ip (momentum + affine (i, j, k)) + impulse ∇w_ip [kg m/s]. The momentum is that at the first node x_0,
    m_p (v_p + C_p (x_0 − x_p)); affine is m_p Δx C_p, impulse −Δt V_p⁰ τ_p/Δx, and ∇ is along x/Δx. Nodes are
    stored at `start` + `slots`. Blocks have `THREADS` threads.

    Args:
        precision: of the values, whose array starts where an allocation does, so that each is aligned.
        width: nodes of a stencil along an axis; weights w and their derivatives d are [3, width].

    Source: paper section 3.3, steps 1 and 2.
    """
    real, vec3, vec4, mat33 = precision.real, precision.vec3, precision.vec4, precision.mat33
    stencil = wp.types.matrix(shape=(3, width), dtype=real)
    warps = THREADS // WARP
    add = _ADD_FP32 if precision is FP32 else _ADD_FP64.format(warps=warps)
    padding = "four_t unused;" if width == 4 else ""  # so that neighbours begin in different banks
    snippet = _SCATTER.format(real=precision.native, width=width, padding=padding, add=add, warps=warps)

    @wp.func_native(snippet)
    def scatter(
        cell: int,
        start: int,
        w: stencil,
        d: stencil,
        mass: real,
        momentum: vec3,
        affine: mat33,
        impulse: mat33,
        shape: wp.vec3i,
        slots: wp.array(dtype=wp.int32),
        values: wp.array(dtype=vec4),
    ): ...

    return scatter


@wp.func_native("return __any_sync(0xffffffffu, mine);")
def any_of_warp(mine: bool) -> bool:
    """Whether it is so for any thread of a warp, all of which call it."""
    ...
