// The sum of `value` over the lanes of a warp, in each lane; `value` where there is one lane.
wp::vec_t<3, real> sum = value;
#if defined(__CUDA_ARCH__)
if (lanes > 1)
    for (int d = 16; d > 0; d /= 2)
        for (int i = 0; i < 3; ++i) sum[i] += __shfl_xor_sync(0xffffffffu, sum[i], d);
#endif
return sum;
