"""Text in files that other programs wrote, in whichever encoding they wrote it."""

from __future__ import annotations

import codecs
import re

UTF_16_MARKS = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
# Control characters but for those that divide lines, columns and pages, and the end mark of old programs.
_NOT_TEXT = re.compile("[\0-\x08\x0e-\x19\x1b-\x1f]")


def decoded(content: bytes) -> str:
    """Return the text that a file holds: UTF-8, UTF-16 where a byte order mark says so, else Latin-1.

    Raises:
        ValueError: it holds no text.
    """
    encoding = "utf-16" if content.startswith(UTF_16_MARKS) else "utf-8-sig"
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError:
        text = content.decode("latin-1")
    if _NOT_TEXT.search(text):
        raise ValueError("it holds other things than text")
    return text
