"""The background grid: its nodes, their storage and interpolation weights (paper sections 3.2 and 3.3)."""
