"""Checks of the files and folders given to a command, made before its work begins."""

import importlib.util
import os
from pathlib import Path

from server.core.errors import NafirError

FIGURES = (".png", ".svg", ".pdf")


def require_readable(path: Path, option: str) -> None:
    """Raises NafirError, which names `option`, if `path` is not a readable file."""
    if not path.exists():
        raise NafirError(f"{option}: {path}: there is no such file")
    if path.is_dir():
        raise NafirError(f"{option}: {path} is a folder, and a file is needed")
    if not os.access(path, os.R_OK):
        raise NafirError(f"{option}: {path} may not be read by this user")


def require_writable(path: Path, option: str) -> None:
    """Raises NafirError, which names `option`, if no file can be written to `path`. Creates and changes nothing."""
    if path.is_dir():
        raise NafirError(f"{option}: {path} is a folder: name a file in it")
    _require_folder(path.parent, option)
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise NafirError(f"{option}: {path} may not be written by this user")


def require_figure(path: Path, option: str) -> None:
    """Raises NafirError, which names `option`, if matplotlib is not installed, if the suffix of `path` is not one of
    `FIGURES`, or if no file can be written there."""
    require_matplotlib(option)
    if path.suffix not in FIGURES:
        raise NafirError(f"{option}: {path}: a picture's name ends in {', '.join(FIGURES)}")
    require_writable(path, option)


def require_matplotlib(option: str) -> None:
    """Raises NafirError, which names `option`, if matplotlib is not installed."""
    if importlib.util.find_spec("matplotlib") is None:
        raise NafirError(f"{option}: needs matplotlib; pip install matplotlib, or leave {option} out")


def require_writable_folder(path: Path, option: str) -> None:
    """Raises NafirError, which names `option`, if `path` neither is nor can become a folder that can be written to. The
    folder and its parents need not exist yet. Creates and changes nothing."""
    existing = next(each for each in (path, *path.absolute().parents) if each.exists())
    if not existing.is_dir():
        raise NafirError(f"{option}: {existing} is a file, and a folder is needed")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise NafirError(f"{option}: nothing may be written to {existing} by this user")


def _require_folder(folder: Path, option: str) -> None:
    if not folder.exists():
        raise NafirError(f"{option}: there is no folder {folder}: make it first")
    if not folder.is_dir():
        raise NafirError(f"{option}: {folder} is no folder")
