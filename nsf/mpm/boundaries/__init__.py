"""Colliders and the domain's walls: shapes, motion and contact."""
