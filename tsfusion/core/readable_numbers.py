# SPDX-License-Identifier: MIT
"""Numbers as a person reads them."""


def grouped(number: float) -> str:
    """1234567 → 1 234 567."""
    return f"{number:,.0f}".replace(",", "\u202f")


def size(count: float) -> str:
    """Bytes with three digits: 12.3 MB."""
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} GB"


def counted(counts: dict[str, int]) -> str:
    """{"spool": 2, "quota": 1} → 2 × spool; 1 × quota. Zeros are left out."""
    return "; ".join(f"{count} × {reason}" for reason, count in counts.items() if count)
