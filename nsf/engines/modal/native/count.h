// Adds `taken`, 0 or 1, to count[run, 0]; threads of a warp that are of one run add together.
#if defined(__CUDA_ARCH__)
unsigned long long* at = (unsigned long long*)count.data + size_t(run) * count.shape[1];
#if __CUDA_ARCH__ >= 700
const unsigned there = __activemask();
const unsigned own = __match_any_sync(there, run);
const unsigned takers = __ballot_sync(there, taken != 0) & own;
const bool first = (threadIdx.x & 31) == __ffs(own) - 1;
if (first && takers != 0) atomicAdd(at, (unsigned long long)__popc(takers));
#else
if (taken != 0) atomicAdd(at, 1ull);
#endif
#else
count.data[size_t(run) * count.shape[1]] += taken;
#endif
