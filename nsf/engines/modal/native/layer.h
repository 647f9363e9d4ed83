// One output of a layer for each run of a tile, by the lanes of a warp; the outputs of the second network
// follow those of the first.
const bool first = output < one.b.shape[1];
const int o = first ? output : output - one.b.shape[1], outputs = first ? one.b.shape[1] : two.b.shape[1];
const int n = first ? one.W.shape[1] : two.W.shape[1];
const real* x = first ? one.x.data : two.x.data;
const int entries_1 = LATENTS > 0 ? one.W_0.shape[0] : one.x.shape[1];
const int entries_2 = LATENTS > 0 ? two.W_0.shape[0] : two.x.shape[1];
const int entries = first ? entries_1 : entries_2;
const int at = o / (outputs / (entries / n)) * n;  // where the entries of the output's member begin
const real* row = (first ? one.W.data : two.W.data) + size_t(o) * n;
// One beyond the last run is done again.
auto of = [&](int s) { return wp::min(start + s, one.x.shape[0] - 1); };
auto entry = [&](int s, int i) {
    if constexpr (LATENTS > 0) {  // found anew from the layer before
        const real* w = (first ? one.W_0.data : two.W_0.data) + size_t(at + i) * LATENTS;
        real z = (first ? one.b_0.data : two.b_0.data)[size_t(of(s)) * entries + at + i];
        for (int c = 0; c < LATENTS; ++c) z += w[c] * x[of(s) * LATENTS + c];
        return z / (real(1) + exp(-z));
    } else {
        return x[size_t(of(s)) * entries + at + i];
    }
};
wp::vec_t<TILE, real> sum;
real bias[TILE];
for (int s = 0; s < TILE; ++s) bias[s] = (first ? one.b.data : two.b.data)[size_t(of(s)) * outputs + o];
#if defined(__CUDA_ARCH__)
constexpr int AHEAD = 9;  // weights of a thread whose loads are under way together: all of 288 inputs
#pragma unroll 1
for (int begin = lane; begin < n; begin += AHEAD * lanes) {
    real w[AHEAD];
    #pragma unroll
    for (int j = 0; j < AHEAD; ++j) w[j] = begin + j * lanes < n ? row[begin + j * lanes] : real(0);
    #pragma unroll
    for (int j = 0; j < AHEAD; ++j) {
        const int i = wp::min(begin + j * lanes, n - 1);
        #pragma unroll
        for (int s = 0; s < TILE; ++s) sum[s] += w[j] * entry(s, i);
    }
}
#else
for (int i = 0; i < n; ++i)
    for (int s = 0; s < TILE; ++s) sum[s] += row[i] * entry(s, i);
#endif
#pragma unroll
for (int s = 0; s < TILE; ++s) {
#if defined(__CUDA_ARCH__)
    for (int d = 16; d > 0; d /= 2) sum[s] += __shfl_xor_sync(0xffffffffu, sum[s], d);
#endif
    sum[s] += bias[s];
}
return sum;
