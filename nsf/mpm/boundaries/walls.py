"""The walls of the domain."""

from dataclasses import dataclass

from nsf.errors import ConfigError
from nsf.mpm.boundaries.colliders import check_kind


@dataclass(frozen=True)
class DomainWalls:
    """The six faces of the domain, `padding` nodes deep.

    Attributes:
        kind: as for `Collider`, without friction.
        padding: nodes from the edge on which the condition holds.

    Raises:
        ConfigError: unknown kind, or a padding that is not a whole number of at least 1.
    """

    kind: str = "separate"
    padding: int = 3

    def __post_init__(self):
        check_kind(self.kind, "walls")
        if not (isinstance(self.padding, int) and self.padding >= 1):
            raise ConfigError(f"walls.padding={self.padding} must be a whole number of nodes, at least 1")
