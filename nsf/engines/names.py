"""Names of the engines, for checks that need none of them."""

#: The engine of a file that `nsf teach` writes.
OPERATORS = "operators"
#: What `engine=` may be: from the fastest to the one that steps whatever can be stepped.
NAMES = ("auto", "modal", "reference", OPERATORS)
#: What `engine.teacher=` may be beside those: the full-order runs of training.
RUNS = "runs"
