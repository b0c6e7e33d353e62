"""What the receivers of a measurement are."""

from enum import StrEnum


class Receivers(StrEnum):
    EARS = "ears"
    """Two, the channels of one binaural response."""
    MICROPHONES = "microphones"
    """Any number, a response of one channel each."""
