"""Training of a manifold (paper section 4.5)."""
