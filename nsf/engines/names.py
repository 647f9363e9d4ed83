"""Names of the engines of projected steps, for checks that need none of them."""

#: What `engine=` may be in Python: from the fastest to the one that steps whatever can be stepped.
NAMES = ("auto", "modal", "reference")
