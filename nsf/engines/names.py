"""Names of the engines, for checks that need none of them."""

#: Those that are of a file that `nsf teach` writes: the operators, and projected steps with a closure.
OPERATORS, CLOSED = "operators", "closed"
#: What `engine=` may be: from the fastest to the one that steps whatever can be stepped.
NAMES = ("auto", "modal", "reference", CLOSED, OPERATORS)
#: What `engine.teacher=` may be beside those: the full-order runs of training.
RUNS = "runs"
