"""Settings of the tests of single modules."""

from hypothesis import settings

# How long an example takes says how busy the computer is, not whether the result is right.
settings.register_profile("unhurried", deadline=None)
settings.load_profile("unhurried")
