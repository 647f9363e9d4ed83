"""Sections of a report that set variants beside each other, and what a variant is."""
