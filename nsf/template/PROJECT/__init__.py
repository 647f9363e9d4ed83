"""Classes that a configuration may name: pyproject.toml declares this package as an entry point of nsf."""
