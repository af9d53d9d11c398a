"""How an accelerator computes; on a processor none of it has an effect."""

from dataclasses import dataclass
from typing import Literal

Matmul = Literal["full", "tf32"]
"""full: products of matrices in float32; tf32: with 10 bits of mantissa, on NVIDIA cards from
Ampere on, several times as fast where networks are large."""


@dataclass(frozen=True)
class ComputeConfig:
    """How an accelerator computes. On a processor it computes as it always does."""

    matmul: Matmul = "full"
    """Precision of products of matrices: float32, or tf32 where the card has it."""
    deterministic: bool = False
    """The same card gives the same numbers again, so that a resumed run is exact; slower."""
