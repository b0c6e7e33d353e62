"""Heads: measured sets of HRTFs, prepared for the sample rates of the scenes."""

import logging
from collections.abc import Iterable
from pathlib import Path

from server.assets.names import named_by_stem
from server.core.errors import RequestError
from server.rendering.hrtf import HeadFilters, Hrtf, kemar

DEFAULT_HRTF = "kemar"

_logger = logging.getLogger(__name__)


class HrtfLibrary:
    """The KEMAR set and `files` (SOFA, SimpleFreeFieldHRIR), each named by its stem. A file of the same name replaces
    KEMAR.

    All sets are read and filtered here, at each of `sample_rates`, so that a stream need not wait. Raises HrtfError for
    the first file that cannot be used, and ValueError if two files have the same stem.
    """

    def __init__(self, files: Iterable[Path], sample_rates: Iterable[int]) -> None:
        named = named_by_stem(files)
        if DEFAULT_HRTF in named:
            _logger.warning("warning: %s takes the place of the bundled head %r", named[DEFAULT_HRTF], DEFAULT_HRTF)
        rates = set(sample_rates)
        self.sample_rates = tuple(sorted(rates))
        self._filters = {(DEFAULT_HRTF, rate): kemar(rate) for rate in rates if DEFAULT_HRTF not in named}
        for name, path in named.items():
            self._filters |= {(name, rate): HeadFilters.from_hrtf(Hrtf.read(path, rate)) for rate in rates}
        self.names = tuple(sorted({DEFAULT_HRTF, *named}))

    def require(self, name: str) -> None:
        """Raises RequestError unknown_hrtf for a name that is not among `names`."""
        if name not in self.names:
            known = ", ".join(self.names)
            raise RequestError("unknown_hrtf", f"there is no HRTF {name!r}, only {known}", field="hrtf", status=404)

    def filters(self, name: str, sample_rate: int) -> HeadFilters:
        """Raises RequestError unknown_hrtf."""
        self.require(name)
        return self._filters[name, sample_rate]
