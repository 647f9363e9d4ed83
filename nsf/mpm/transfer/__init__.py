"""Transfers between particles and grid: P2G and G2P (paper section 3.3, steps 1 and 3)."""

from typing import TYPE_CHECKING

from nsf.extras import on_first_use

if TYPE_CHECKING:
    from nsf.mpm.transfer.g2p import make_g2p, make_g2p_stress
    from nsf.mpm.transfer.p2g import make_p2g
    from nsf.mpm.transfer.scheme import Transfer

__all__ = ["Transfer", "make_g2p", "make_g2p_stress", "make_p2g"]

__getattr__ = on_first_use(__name__)
