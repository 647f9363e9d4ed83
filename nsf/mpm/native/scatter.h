// What the particles of a warp give to nodes; a CPU has none of it.
#if defined(__CUDA_ARCH__)
constexpr int NODES = WIDTH * WIDTH * WIDTH;
struct alignas(2 * sizeof(real)) weight_t { real value, slope; };
struct alignas(16) four_t { real of[4]; };
struct particle_t {
    weight_t weights[3][WIDTH];
    // Rows; beside them the momentum at the first node, and the mass. Of four nodes there is one row more,
    // so that neighbours begin in different banks.
    four_t affine[3], impulse[WIDTH == 4 ? 4 : 3];
};
__shared__ particle_t carried[WARPS][32];
__shared__ int cells[WARPS][32], starts[WARPS][32];
const unsigned all = 0xffffffffu;
const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
const unsigned live = __ballot_sync(all, cell >= 0);
// Where another cell or another simulation begins.
const int before = __shfl_up_sync(all, cell, 1), start_before = __shfl_up_sync(all, start, 1);
const bool another = lane == 0 || before != cell || start_before != start;
const unsigned heads = __ballot_sync(all, cell >= 0 && another);
if (cell >= 0) {
    particle_t& own = carried[warp][lane];
    for (int axis = 0; axis < 3; ++axis)
        for (int j = 0; j < WIDTH; ++j) own.weights[axis][j] = {w.data[axis][j], d.data[axis][j]};
    for (int i = 0; i < 3; ++i) {
        own.affine[i] = {affine.data[i][0], affine.data[i][1], affine.data[i][2], momentum[i]};
        own.impulse[i] = {impulse.data[i][0], impulse.data[i][1], impulse.data[i][2], mass};
    }
    cells[warp][lane] = cell;
    starts[warp][lane] = start;
}
__syncwarp();
for (int turn = 0; turn < NODES; turn += 32) {
    const bool has_node = turn + lane < NODES;
    const int node = wp::min(turn + lane, NODES - 1);
    const int a = node / (WIDTH * WIDTH), b = node / WIDTH % WIDTH, c = node % WIDTH;
    const int offset = (a * shape[1] + b) * shape[2] + c;
    const real n_x = real(a), n_y = real(b), n_z = real(c);
    auto stored = [&](int p) {
        const int flat = cells[warp][p] + offset, at = slots.shape[0] > 0 ? slots.data[flat] : flat;
        return has_node && at >= 0 ? starts[warp][p] + at : -1;
    };
    real sum[4] = {};
    int first = __ffs(heads) - 1, place = stored(first);
    #pragma unroll 1
    for (unsigned left = heads & (heads - 1);; left &= left - 1) {
        // Looked up while this run is added up.
        const int next = left ? __ffs(left) - 1 : first, place_of_next = stored(next);
        const unsigned after = (heads | ~live) & ~(all >> (31 - first));
        const int end = after ? __ffs(after) - 1 : 32;
        #pragma unroll 2
        for (int p = first; p < end; ++p) {
            const particle_t& at = carried[warp][p];
            const weight_t x = at.weights[0][a], y = at.weights[1][b], z = at.weights[2][c];
            const real plane = x.value * y.value, weight = plane * z.value;
            const real s_x = x.slope * y.value * z.value, s_y = x.value * y.slope * z.value;
            for (int i = 0; i < 3; ++i) {
                const four_t m = at.affine[i], f = at.impulse[i];
                sum[i] += weight * (m.of[3] + m.of[0] * n_x + m.of[1] * n_y + m.of[2] * n_z);
                sum[i] += f.of[0] * s_x + f.of[1] * s_y + f.of[2] * (plane * z.slope);
            }
            sum[3] += weight * at.impulse[0].of[3];
        }
        // The next cell along the last axis has every node of this one but the first of each column. It
        // is in the same row: no stencil begins where it would reach over a row's end.
        const bool goes_on =
            cells[warp][next] == cells[warp][first] + 1 && starts[warp][next] == starts[warp][first];
        const int slot = goes_on && c > 0 ? -1 : place;
        if constexpr (sizeof(real) == 4) {
            // One reduction of 16 bytes (compute capability 9.0) in place of four of 4 bytes.
#if __CUDA_ARCH__ >= 900
            if (slot >= 0)
                asm volatile(
                    "red.global.add.v4.f32 [%0], {%1, %2, %3, %4};" ::"l"(&wp::index(values, slot)),
                    "f"((float)sum[0]), "f"((float)sum[1]), "f"((float)sum[2]), "f"((float)sum[3])
                    : "memory");
#else
            const wp::vec_t<4, real> added(sum[0], sum[1], sum[2], sum[3]);
            if (slot >= 0) wp::atomic_add(values, slot, added);
#endif
        } else {
            // There is none of 32 bytes: four threads take one value each, so that they are one access.
            __shared__ real sums[WARPS][32][4];
            for (int i = 0; i < 4; ++i) sums[warp][lane][i] = sum[i];
            __syncwarp();
            const int stride = goes_on ? WIDTH : 1;  // the first nodes of columns, or all
            for (int n = 0; n < 32; n += 8 * stride) {
                const int giver = n + lane / 4 * stride, at = __shfl_sync(all, slot, giver % 32);
                if (giver < 32 && at >= 0)
                    atomicAdd((real*)&wp::index(values, at) + lane % 4, sums[warp][giver][lane % 4]);
            }
            __syncwarp();
        }
        if (!left) break;
        for (int i = 0; i < 4; ++i) {
            const real handed_on = __shfl_down_sync(all, sum[i], 1);
            sum[i] = goes_on && c < WIDTH - 1 ? handed_on : real(0);
        }
        first = next;
        place = place_of_next;
    }
}
#endif
