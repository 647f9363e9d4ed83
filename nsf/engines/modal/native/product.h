// EDGE outputs of a member's layer in each of EDGE runs, by a block of a GPU; `first` blocks of a tile of
// runs are of the first network.
const int T = threadIdx.x, lane = T % 32, warp = T / 32;
__shared__ real w[DEEP][EDGE + 1], h[DEEP][EDGE + 1];
const int runs = one.x.shape[0], each = blocks / ((runs + EDGE - 1) / EDGE);
const int block = blockIdx.x % each, start = blockIdx.x / each * EDGE;
const bool of_one = block < first;
const int n = of_one ? one.W.shape[1] : two.W.shape[1], outputs = of_one ? one.b.shape[1] : two.b.shape[1];
const int entries = of_one ? one.x.shape[1] : two.x.shape[1];
const int own = outputs / (entries / n), chunks = (own + EDGE - 1) / EDGE;  // of a member
const int member = (of_one ? block : block - first) / chunks;
const int from = (of_one ? block : block - first) % chunks * EDGE;
const real* W = (of_one ? one.W.data : two.W.data) + size_t(member) * own * n;
const real* x = (of_one ? one.x.data : two.x.data) + size_t(member) * n;
// An output or a run beyond the last one is that one again, and not written.
real sum[4][2] = {};
for (int begin = 0; begin < n; begin += DEEP) {
    const int i = begin + T;
    #pragma unroll
    for (int j = 0; j < EDGE; ++j) {
        w[T][j] = i < n ? W[size_t(wp::min(from + j, own - 1)) * n + i] : real(0);
        h[T][j] = i < n ? x[size_t(wp::min(start + j, runs - 1)) * entries + i] : real(0);
    }
    __syncthreads();
    const int end = wp::min(n - begin, 32 * warp + 32);
    #pragma unroll 4
    for (int k = 32 * warp; k < end; ++k)
        for (int u = 0; u < 4; ++u)
            for (int v = 0; v < 2; ++v) sum[u][v] += w[k][lane % 4 + 4 * u] * h[k][lane / 4 + 8 * v];
    __syncthreads();
}
real(*share)[EDGE * EDGE] = (real(*)[EDGE * EDGE])w;
for (int u = 0; u < 4; ++u)
    for (int v = 0; v < 2; ++v) share[warp][(lane / 4 + 8 * v) * EDGE + lane % 4 + 4 * u] = sum[u][v];
__syncthreads();
for (int e = T; e < EDGE * EDGE; e += blockDim.x) {
    const int s = start + e / EDGE, o = from + e % EDGE;
    if (s >= runs || o >= own) continue;
    const size_t at = size_t(s) * outputs + member * own + o;
    real z = (of_one ? one.b.data : two.b.data)[at];
    for (int j = 0; j < 4; ++j) z += share[j][e];
    (of_one ? one.y.data : two.y.data)[at] = active ? z / (real(1) + exp(-z)) : z;
}
