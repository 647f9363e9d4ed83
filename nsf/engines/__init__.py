"""Engines: how a reduced step is computed."""
