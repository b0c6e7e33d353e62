"""Copies what a Python environment needs to run into an empty folder: `python root.py FOLDER ENVIRONMENT`.

That is the environment, the interpreter with its standard library, and every shared library that one of their files is
linked to, of the system's and of those that packages bring in folders named `*.libs`. Of a library that both bring, the
system's is taken. What is left is the root of an image without a shell, a package manager or a compiler.
"""

import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterable, Iterator
from pathlib import Path

OPENED = ("libopus.so.0",)
"""Libraries that are opened by name while the server runs."""
LEFT_OUT = (
    *("test", "idlelib", "lib2to3", "ensurepip", "tkinter", "turtledemo", "pydoc_data", "site-packages"),
    *("dist-packages", "__pycache__", "config-*", "*.a", "LICENSE.txt", "_test*.so", "_xxtestfuzz*.so"),
    *("sqlite3", "_sqlite3*.so", "dbm", "_dbm*.so", "_gdbm*.so"),
)
"""What of the standard library no server imports."""
OF_BOTH = ("libbz2", "libcrypto", "liblzma", "libssl", "libzstd")
"""Libraries with a stable interface, of which packages bring copies. The system's packagers mend theirs sooner."""
SETTINGS = (
    *("etc/passwd", "etc/group", "etc/nsswitch.conf", "etc/ssl/certs/ca-certificates.crt", "etc/ssl/openssl.cnf"),
    *("etc/os-release", "usr/lib/os-release", "etc/debian_version"),
)
"""Files of the system that libraries, or scanners of images, read."""
EMPTY = {**dict.fromkeys(("dev", "proc", "run", "sys"), 0o755), **dict.fromkeys(("tmp", "var/tmp", "cache"), 0o1777)}
"""Empty folders by their modes. A new volume at /cache takes over the mode, so that the server may write to it."""


def copy(root: Path, file: Path) -> None:
    """Copy a file with every link on the way to it, and each folder that is a link, as Debian's /lib."""
    for folder in reversed(file.parents[:-1]):
        inside = root / folder.relative_to("/")
        if folder.is_symlink():
            if not inside.is_symlink():
                inside.parent.mkdir(parents=True, exist_ok=True)
                inside.symlink_to(folder.readlink())
            copy(root, folder.resolve() / file.relative_to(folder))
            return
    target = root / file.relative_to("/")
    target.parent.mkdir(parents=True, exist_ok=True)
    if not target.exists() and not target.is_symlink():
        shutil.copy2(file, target, follow_symlinks=False)
    if file.is_symlink():
        copy(root, file.parent / file.readlink())


def linked(files: Iterable[Path]) -> Iterator[Path]:
    """The libraries of the system that files are linked to, of all that are found."""
    listed = subprocess.run(["ldd", *map(str, files)], capture_output=True, text=True, check=False).stdout
    for line in listed.splitlines():
        words = line.split()
        found = words[2] if words[1:2] == ["=>"] and len(words) > 2 else words[0] if words else ""
        if found.startswith("/") and not found.endswith(":"):
            yield Path(os.path.normpath(found))  # packages name their own by "..", and links are kept


def shared(root: Path) -> list[Path]:
    return [each for each in root.rglob("*.so*") if each.is_file()]


def is_bundled(file: Path) -> bool:
    """Whether a library came with a package that links to it, or did so before parts of it were left out."""
    return file.parent.name.endswith(".libs")


def known() -> dict[str, Path]:
    """The libraries of the system by their names."""
    listed = subprocess.run(["ldconfig", "-p"], capture_output=True, text=True, check=True).stdout
    lines = [line.split() for line in listed.splitlines() if " => " in line]
    return {words[0]: Path(words[-1]) for words in reversed(lines)}  # of several with a name, the first is loaded


def of_both(bundled: str, names: Iterable[str]) -> str | None:
    """The one of the system's names that stands for a library of `OF_BOTH` in a package, such as `libbz2.so.1.0` for
    `libbz2-a1e77c99.so.1.0.6`: packagers add a digest to the name, and some the whole version."""
    base, _, version = bundled.partition(".so.")
    base = base.partition("-")[0]
    if base not in OF_BOTH:
        return None
    return next((name for name in names if f"{base}.so.{version}.".startswith(f"{name}.")), None)


def link_to_system(root: Path, libraries: dict[str, Path]) -> list[Path]:
    """Replace libraries that packages in a root bring by links to the system's, which are returned. Raises RuntimeError
    if one of what is left in their folders then lacks a symbol."""
    taken = []
    for each in shared(root):
        name = of_both(each.name, libraries) if is_bundled(each) else None
        if name:
            each.unlink()
            each.symlink_to(libraries[name])
            taken.append(each)
    for folder in {each.parent for each in taken}:
        files = [str(each) for each in folder.iterdir() if each not in taken]
        told = subprocess.run(["ldd", "-r", *files], capture_output=True, text=True, check=False)
        missing = [
            line for line in (told.stdout + told.stderr).splitlines() if "undefined" in line or "not found" in line
        ]
        if missing:
            raise RuntimeError(f"{folder.name} needs other libraries than the system's: {missing}")
    return taken


def make_empty(root: Path) -> None:
    """Make the folders of `EMPTY`."""
    for name, mode in EMPTY.items():
        (root / name).mkdir(parents=True, exist_ok=True)
        (root / name).chmod(mode)


def main(root: Path, environment: Path) -> None:
    library = Path(sysconfig.get_path("stdlib"))
    ignored = shutil.ignore_patterns(*LEFT_OUT)
    shutil.copytree(library, root / library.relative_to("/"), symlinks=True, ignore=ignored)
    shutil.copytree(environment, root / environment.relative_to("/"), symlinks=True)
    libraries = known()
    links = link_to_system(root, libraries)
    opened = [libraries[name] for name in OPENED]
    interpreter = Path(sys.base_prefix) / "bin" / Path(sys.executable).name
    programs = [interpreter.resolve(), *(each for each in shared(root) if not is_bundled(each))]
    found = [interpreter, *opened, *linked([*programs, *opened])]
    for each in shared(root):
        if is_bundled(each) and each not in found:
            each.unlink()
    found += [link.readlink() for link in links if link.is_symlink()]
    for file in dict.fromkeys(found):
        if not file.is_relative_to(environment) and not file.is_relative_to(root):
            copy(root, file)
    for link in (environment / "bin").iterdir():  # the environment's interpreters are links to the system's
        if link.is_symlink() and link.readlink().is_absolute():
            copy(root, link.readlink())
    for name in SETTINGS:
        if Path("/", name).exists():
            copy(root, Path("/", name))
    make_empty(root)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
