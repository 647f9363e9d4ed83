// Σ_p w_p B_p,kᵀ Δt v_p over S of a run, for mode k; beyond the last mode Σ_p w_p |Δt v_p|².
const double dt = gathered.dt;
const int particles = gathered.weights.shape[0], modes = gathered.b.shape[1] - 1, vectors = (modes + 3) / 4;
const auto* v = gathered.v.data + size_t(run) * gathered.rows;
double sum = 0.0;
#pragma unroll 4
for (int p = lane; p < particles; p += lanes) {
    const double x = double(v[p][0]), y = double(v[p][1]), z = double(v[p][2]);
    double one = dt * x, two = dt * y, three = dt * z;
    if (k < modes) {
#if defined(__CUDA_ARCH__)
        const size_t next = size_t(vectors) * particles * 4;
        const wp::float32* at = gathered.displacement.data + (size_t(k / 4) * particles + p) * 4 + k % 4;
#else
        const size_t next = 4 * vectors;
        const wp::float32* at = gathered.displacement.data + size_t(p) * 3 * next + k;
#endif
        one = at[0];
        two = at[next];
        three = at[2 * next];
    }
    sum += gathered.weights.data[p] * (one * x + two * y + three * z);
}
sum *= dt;
#if defined(__CUDA_ARCH__)
__shared__ double partial[32];
for (int d = 16; d > 0; d /= 2) sum += __shfl_xor_sync(0xffffffffu, sum, d);
if (threadIdx.x % 32 == 0) partial[threadIdx.x / 32] = sum;
__syncthreads();
sum = 0.0;
for (int w = 0; w < blockDim.x / 32; ++w) sum += partial[w];
#endif
return sum;
