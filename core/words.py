"""Words and numbers as people read them."""

from __future__ import annotations


def with_minus_sign(number: str) -> str:
    """Return a number with a real minus sign; a hyphen joins words."""
    return number.replace("-", "\N{MINUS SIGN}")
