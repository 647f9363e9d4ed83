"""A reduced step for fields that are modes times coefficients, in compiled kernels."""
