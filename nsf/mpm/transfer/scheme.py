"""How velocities travel between particles and grid."""

from dataclasses import dataclass

from nsf.errors import ConfigError
from nsf.mpm.grid.shape import DEGREES

SCHEMES = ("pic", "apic", "rpic")


@dataclass(frozen=True)
class Transfer:
    """How velocities travel between particles and grid.

    Attributes:
        scheme: `pic` carries no affine momentum; `apic` carries all of it; `rpic` carries its
            rotation, and the share `1 − damping` of its symmetric part.
        shape: B-spline, `quadratic` or `cubic`.
        damping: RPIC damping in (0, 1], dimensionless; 1 keeps rotation only. 0 would be APIC.
        deterministic: on a GPU, sum P2G's contributions in a fixed order, so that the same run gives
            the same bits (slower). A CPU always does.

    Raises:
        ConfigError: unknown scheme or shape; damping outside [0, 1], not with RPIC, or RPIC without.

    Source: Jiang et al. 2015 (APIC); Fang et al. 2019 (RPIC damping).
    """

    scheme: str = "apic"
    shape: str = "quadratic"
    damping: float = 0.0
    deterministic: bool = False

    def __post_init__(self):
        if self.scheme not in SCHEMES:
            raise ConfigError(
                f"transfer.scheme={self.scheme!r} is unknown; choose one of {', '.join(SCHEMES)}"
            )
        if self.shape not in DEGREES:
            raise ConfigError(f"transfer.shape={self.shape!r} is unknown; choose one of {', '.join(DEGREES)}")
        if not 0.0 <= self.damping <= 1.0:
            raise ConfigError(f"transfer.damping={self.damping} must lie in [0, 1]")
        if self.damping and self.scheme != "rpic":
            raise ConfigError(
                f"transfer.damping={self.damping} needs transfer.scheme=rpic, not {self.scheme}"
            )

        if self.scheme == "rpic" and not self.damping:
            raise ConfigError(
                "transfer.damping=0 makes rpic the same as apic; set transfer=apic, or a damping up to 1"
            )

    @property
    def affine_shares(self) -> tuple[float, float]:
        """Shares of the symmetric and of the skew part of C that are kept."""
        return {"pic": (0.0, 0.0), "apic": (1.0, 1.0), "rpic": (1.0 - self.damping, 1.0)}[self.scheme]
