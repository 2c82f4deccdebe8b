"""The two ways a measurement stops early: input that cannot be used, and a person who changed their mind."""

from __future__ import annotations


class InputError(Exception):
    """Input that cannot be used, said in one sentence that names the file, the place in it and the remedy.

    The message is shown to people as it stands, on the terminal and in the browser.
    """


class Cancelled(Exception):
    """The person asked to stop; everything measured so far is kept."""
