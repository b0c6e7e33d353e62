"""Imports numba without two packages that it only looks at: import this module before anything of numba's.

Numba imports SciPy to compare its version, and yaml to read a `.numba_config.yaml` in the working directory. Together
they are a tenth of its import. Both can be imported as usual afterwards.
"""

import sys
from pathlib import Path
from typing import Any

_ABSENT: dict[str, Any] = dict.fromkeys(
    name
    for name in ("scipy", "yaml")
    if name not in sys.modules and not (name == "yaml" and Path(".numba_config.yaml").exists())
)
if "numba" not in sys.modules:
    sys.modules.update(_ABSENT)  # an entry of None makes an import raise ImportError, which numba expects
    try:
        import numba  # noqa: F401
    finally:
        for _name in _ABSENT:
            del sys.modules[_name]
