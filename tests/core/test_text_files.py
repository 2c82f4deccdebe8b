"""Text is read in whichever usual encoding it was written, and nothing else is taken for text."""

from __future__ import annotations

import pytest

from core.text_files import decoded

TEXT = "Höhe,µ\r\n1,2\n"


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "latin-1"])
def test_text_comes_back_whatever_its_encoding(encoding: str) -> None:
    assert decoded(TEXT.encode(encoding)) == TEXT


def test_big_endian_text_is_told_by_its_mark() -> None:
    assert decoded(b"\xfe\xff" + TEXT.encode("utf-16-be")) == TEXT


@pytest.mark.parametrize("content", [bytes(100), b"\x89PNG\r\n\x1a\n\x00", TEXT.encode("utf-16-le"), b"\xff\xfe\x00"])
def test_anything_else_is_refused(content: bytes) -> None:
    with pytest.raises(ValueError, match="holds other things than text"):
        decoded(content)
