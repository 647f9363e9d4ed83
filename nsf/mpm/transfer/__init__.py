"""Transfers between particles and grid: P2G and G2P (paper section 3.3, steps 1 and 3)."""
