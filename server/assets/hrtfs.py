"""Heads: measured sets of HRTFs, prepared for the sample rates of scenes and streams."""

import logging
from collections.abc import Iterable
from pathlib import Path
from threading import Lock

from server.assets.names import named_by_stem
from server.core.errors import RequestError
from server.rendering.hrtf import HeadFilters, Hrtf, kemar
from server.rendering.sofa import HrtfError
from server.scene.limits import STREAM_RATES_HZ

DEFAULT_HRTF = "kemar"

_logger = logging.getLogger(__name__)


class HrtfLibrary:
    """The KEMAR set and `files` (SOFA, SimpleFreeFieldHRIR), each named by its stem. A file of the same name replaces
    KEMAR.

    All sets are read and filtered here, at each of `sample_rates`, so that a stream need not wait; at other rates when
    one is first asked for. Raises HrtfError for the first file that cannot be used, and ValueError if two files have
    the same stem. Safe to use from any thread.
    """

    def __init__(self, files: Iterable[Path], sample_rates: Iterable[int]) -> None:
        named = named_by_stem(files)
        if DEFAULT_HRTF in named:
            _logger.warning("warning: %s takes the place of the bundled head %r", named[DEFAULT_HRTF], DEFAULT_HRTF)
        rates = set(sample_rates)
        self.sample_rates = tuple(sorted(rates | set(STREAM_RATES_HZ)))
        self.names = tuple(sorted({DEFAULT_HRTF, *named}))
        self._files = named
        self._lock = Lock()
        self._filters: dict[tuple[str, int], HeadFilters] = {}
        for name in self.names:
            for rate in rates:
                self._filters[name, rate] = self._prepared(name, rate)

    def offer(self, sample_rate: int) -> None:
        """Add a rate to `sample_rates`, for a scene that has come later. Its filters are made when first asked for."""
        self.sample_rates = tuple(sorted({*self.sample_rates, sample_rate}))

    def require(self, name: str) -> None:
        """Raises RequestError unknown_hrtf for a name that is not among `names`."""
        if name not in self.names:
            known = ", ".join(self.names)
            raise RequestError("unknown_hrtf", f"there is no HRTF {name!r}, only {known}", field="hrtf", status=404)

    def filters(self, name: str, sample_rate: int) -> HeadFilters:
        """The filters at one of `sample_rates`. The first call for a rate that no scene has takes half a second or
        more. Raises RequestError unknown_hrtf, also if the file cannot be read any more."""
        self.require(name)
        key = name, sample_rate
        if key not in self._filters:  # what is prepared waits for no lock
            with self._lock:
                if key not in self._filters:
                    self._filters[key] = self._prepared_late(name, sample_rate)
        return self._filters[key]

    def _prepared_late(self, name: str, sample_rate: int) -> HeadFilters:
        try:
            return self._prepared(name, sample_rate)
        except (HrtfError, OSError) as exc:
            problem = f"HRTF {name!r} cannot be prepared for {sample_rate} Hz: {exc}"
            raise RequestError("unknown_hrtf", problem, field="hrtf", status=404) from exc

    def _prepared(self, name: str, sample_rate: int) -> HeadFilters:
        path = self._files.get(name)
        return kemar(sample_rate) if path is None else HeadFilters.from_hrtf(Hrtf.read(path, sample_rate))
