// The displacement and its rate at one particle of S, by all lanes of a warp, or by a CPU's thread.
const int K = motion.a.shape[1], Q = (K + 3) / 4;
const double *const of_a = motion.a.data + run * K, *const of_rate = motion.rate.data + run * K;
wp::vec_t<6, real> sum;
#if defined(__CUDA_ARCH__)
const float4* first = (const float4*)modes.data + p;
for (int q = lane; q < Q; q += 32) {
    #pragma unroll
    for (int c = 0; c < 3; ++c) {
        const float4 w = __ldg(first + size_t(c * Q + q) * motion.of_sample);
        const float each[4] = {w.x, w.y, w.z, w.w};
        #pragma unroll
        for (int j = 0; j < 4; ++j) {
            if (4 * q + j >= K) break;
            sum[c] += real(each[j]) * real(of_a[4 * q + j]);
            sum[3 + c] += real(each[j]) * real(of_rate[4 * q + j]);
        }
    }
}
for (int d = 16; d > 0; d /= 2)
    for (int i = 0; i < 6; ++i) sum[i] += __shfl_xor_sync(0xffffffffu, sum[i], d);
#else
for (int c = 0; c < 3; ++c) {
    const wp::float32* w = modes.data + (size_t(p) * 3 + c) * 4 * Q;
    for (int k = 0; k < K; ++k) {
        sum[c] += real(w[k]) * real(of_a[k]);
        sum[3 + c] += real(w[k]) * real(of_rate[k]);
    }
}
#endif
return sum;
