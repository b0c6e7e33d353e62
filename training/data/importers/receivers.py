"""The kinds of receivers that a measurement can have."""

from enum import StrEnum


class Receivers(StrEnum):
    EARS = "ears"
    """Two receivers, which are the channels of one binaural response."""
    MICROPHONES = "microphones"
    """Any number of receivers; each gives a response of one channel."""
