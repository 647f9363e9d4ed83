// values[slot] by accesses of 16 bytes.
#if defined(__CUDA_ARCH__)
const auto* at = &wp::index(values, slot);
if constexpr (sizeof(real) == 4) {
    const float4 v = *reinterpret_cast<const float4*>(at);
    return wp::vec_t<4, real>(v.x, v.y, v.z, v.w);
} else {
    const double2 v = reinterpret_cast<const double2*>(at)[0], w = reinterpret_cast<const double2*>(at)[1];
    return wp::vec_t<4, real>(v.x, v.y, w.x, w.y);
}
#else
return wp::index(values, slot);
#endif
