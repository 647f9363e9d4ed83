"""The latent manifold of the reduced model: encoder e, fields g, h, l and their training (paper section 4).

Import from the modules: `manifold` (load, restrict), `mlp` and `basis` (the two fields), `schedules` and
`training`. Nothing is imported here, so that deploying a manifold does not load Lightning.
"""
