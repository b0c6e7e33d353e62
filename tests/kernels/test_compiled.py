"""Compiled code is kept on disk, never outlives its source, and where it works in place allocates nothing."""

import fcntl
import os
import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba.core.errors import NumbaError

import server
from server.kernels.compiled import compiled, compiled_in_place, compiled_loosely

MODULES = {
    "server/__init__.py": "",
    "server/kernels/__init__.py": "",
    "server/inner.py": "from server.kernels.compiled import compiled\n\n@compiled\ndef inner(x):\n    return x + 1\n",
    "server/outer.py": (
        "from server.kernels.compiled import compiled\nfrom server.inner import inner\n\n"
        "@compiled\ndef outer(x):\n    return 10 * inner(x)\n"
    ),
}
KERNELS = Path(server.__file__).parent / "kernels"
RUN = "from server.outer import outer; print(outer(1), sum(outer.stats.cache_hits.values()))"


@pytest.fixture
def package(tmp_path):
    for name, source in MODULES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(source)
    for name in ("compiled.py", "dispatchers.py", "lean_numba.py"):
        shutil.copy(KERNELS / name, tmp_path / "server" / "kernels")
    return tmp_path


def run(package, **environment):
    """What `outer(1)` gives, and whether it came from disk."""
    environment = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"} | environment
    environment["PYTHONPATH"] = str(package)
    # Bytecode is told from that of a source which was changed within the same second by its size alone.
    environment["PYTHONDONTWRITEBYTECODE"] = "1"
    output = subprocess.run(
        [sys.executable, "-c", RUN], cwd=package, env=environment, check=True, capture_output=True, text=True
    )
    value, hits = output.stdout.split()
    return int(value), int(hits)


def test_a_second_start_compiles_nothing(package):
    assert run(package) == (20, 0)
    assert run(package) == (20, 1)
    assert list((package / "server" / "__pycache__").glob("outer.outer-*.nbc"))


def test_of_processes_that_start_at_once_one_compiles_and_the_others_load_it(package):
    once_told = RUN.replace("; print", "; print(flush=True); input(); print")
    command = [sys.executable, "-c", once_told]
    environment = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    environment["PYTHONPATH"] = str(package)
    processes = [
        subprocess.Popen(
            command, cwd=package, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        for _ in range(3)
    ]
    for process in processes:
        process.stdout.readline()
    for process in processes:
        process.stdin.write("\n")
        process.stdin.flush()
    assert sorted(process.communicate()[0].split() for process in processes) == [["20", "0"], ["20", "1"], ["20", "1"]]


def test_who_compiles_for_too_long_is_not_waited_for(package):
    assert run(package) == (20, 0)
    (folder,) = package.glob("server/__pycache__")
    (lock,) = folder.glob("outer.outer-*.lock")
    for kept in folder.glob("outer.outer-*.nb*"):
        kept.unlink()
    source = package / "server" / "kernels" / "compiled.py"
    source.write_text(
        source.read_text().replace("_LONGEST_COMPILATION_S: Final = 120.0", "_LONGEST_COMPILATION_S = 0.2")
    )
    with lock.open() as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert run(package) == (20, 0)


def test_where_the_lock_cannot_be_opened_a_start_compiles_all_the_same(package):
    """As that of another user, which root could open."""
    run(package)
    folder = package / "server" / "__pycache__"
    (lock,) = folder.glob("outer.outer-*.lock")
    for kept in folder.glob("outer.outer-*"):
        kept.unlink()
    lock.mkdir()
    assert run(package) == (20, 0)
    assert run(package) == (20, 1)


def test_what_is_kept_runs_without_what_only_compiling_needs(package):
    """Rules of typing and lowering, a third of a second."""
    assert run(package) == (20, 0)
    check = f"{RUN}; import sys; print('numba.np.arraymath' in sys.modules)"
    environment = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    output = subprocess.run(
        [sys.executable, "-c", check],
        cwd=package,
        env=environment | {"PYTHONPATH": str(package)},
        check=True,
        capture_output=True,
        text=True,
    )
    assert output.stdout.split() == ["20", "1", "False"]


def test_what_is_kept_of_numbas_own_functions_is_read_without_their_modules(package):
    """Code that allocates arrays may raise what `numba.np.arrayobj` raises, which takes long to import."""
    outer = package / "server" / "outer.py"
    outer.write_text(
        "import numpy as np\nfrom server.kernels.compiled import compiled\n\n"
        "@compiled\ndef outer(x):\n    return np.empty(x).size\n"
    )
    check = (
        "from server.outer import outer; import sys; print(outer(3), sum(outer.stats.cache_hits.values()), "
        "'numba.np.arrayobj' in sys.modules)\ntry:\n    outer(-1)\nexcept ValueError as exc:\n    print(exc)"
    )
    environment = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    environment["PYTHONPATH"] = str(package)
    command = [sys.executable, "-c", check]
    for told in ("3 0 True", "3 1 False"):
        output = subprocess.run(command, cwd=package, env=environment, check=True, capture_output=True, text=True)
        assert output.stdout.splitlines() == [told, "negative dimensions not allowed"]


def test_numba_is_imported_without_scipy_and_yaml_which_can_be_imported_afterwards(tmp_path):
    check = (
        "import server.kernels.compiled, sys; print('scipy' in sys.modules, 'yaml' in sys.modules); "
        "import scipy, yaml; print(scipy.__name__, yaml.__name__)"
    )
    environment = os.environ | {"PYTHONPATH": str(KERNELS.parents[1])}
    command = [sys.executable, "-c", check]
    for told in ("False False", "False True"):
        output = subprocess.run(command, cwd=tmp_path, env=environment, check=True, capture_output=True, text=True)
        assert output.stdout.splitlines() == [told, "scipy yaml"]
        (tmp_path / ".numba_config.yaml").write_text("opt: 3\n")  # numba asks yaml for it


def test_what_is_on_disk_for_this_processor_is_known(package):
    check = (
        "import server.kernels.compiled as c, server.outer as o; before = c.is_kept(o.outer); o.outer(1); "
        "print(before, c.is_kept(o.outer), c.functions_compiled())"
    )
    environment = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    environment["PYTHONPATH"] = str(package)
    command = [sys.executable, "-c", check]
    for told in ("False True 2", "True True 0"):
        output = subprocess.run(command, cwd=package, env=environment, check=True, capture_output=True, text=True)
        assert output.stdout.strip() == told


def test_a_change_in_a_function_called_is_heeded(package):
    assert run(package) == (20, 0)
    inner = package / "server" / "inner.py"
    inner.write_text(inner.read_text().replace("x + 1", "x + 2"))
    assert run(package) == (30, 0)


def test_what_was_kept_of_other_sources_is_not_even_read(package):
    """It may name modules that have moved since."""
    assert run(package) == (20, 0)
    (index,) = (package / "server" / "__pycache__").glob("outer.outer-*.nbi")
    with index.open("rb") as file:
        version = pickle.load(file)  # noqa: S301  what was written here
    index.write_bytes(pickle.dumps(version) + b"cmodule_that_moved\nname\n.")
    inner = package / "server" / "inner.py"
    inner.write_text(inner.read_text().replace("x + 1", "x + 2"))
    assert run(package) == (30, 0)


def test_the_folder_can_be_chosen(package, tmp_path_factory):
    folder = tmp_path_factory.mktemp("cache")
    assert run(package, NUMBA_CACHE_DIR=str(folder)) == (20, 0)
    assert run(package, NUMBA_CACHE_DIR=str(folder)) == (20, 1)
    assert list(folder.glob("**/*.nbc"))
    assert not list(package.glob("**/*.nbc"))


def test_where_nothing_can_be_written_what_is_there_is_read(package):
    """A folder is made unwritable for anyone, root too, by a file in its place, or by what fills it being elsewhere."""
    assert run(package) == (20, 0)
    check = (
        "import server.kernels.compiled as c; c._is_writable = lambda folder: False; "
        "import server.outer as o; print(o.outer(1), sum(o.outer.stats.cache_hits.values()))"
    )
    environment = os.environ | {"PYTHONPATH": str(package)}
    environment.pop("NUMBA_CACHE_DIR", None)
    files = sorted(package.glob("**/*.nb?"))
    for expected, prepare in (("20 1", lambda: None), ("20 0", lambda: [path.unlink() for path in files])):
        prepare()
        output = subprocess.run(
            [sys.executable, "-c", check], cwd=package, env=environment, check=True, capture_output=True, text=True
        )
        assert output.stdout.strip() == expected
    assert not list(package.glob("**/*.nbc"))


def test_a_new_folder_is_filled_up_from_what_cannot_be_written_to(package, tmp_path_factory):
    """As the volume of a container whose image holds compiled code: only what that lacks is compiled and kept."""
    assert run(package) == (20, 0)
    folder = tmp_path_factory.mktemp("cache")
    check = (
        "import server.kernels.compiled as c; is_writable = c._is_writable; "
        "c._is_writable = lambda folder: folder.name != '__pycache__' and is_writable(folder); "
        "import server.outer as o; "
        "print(c.is_kept(o.outer), o.outer(1), o.outer(1.5), sum(o.outer.stats.cache_hits.values()))"
    )
    environment = os.environ | {"PYTHONPATH": str(package), "NUMBA_CACHE_DIR": str(folder)}

    def told():
        command = [sys.executable, "-c", check]
        return subprocess.run(command, cwd=package, env=environment, check=True, capture_output=True, text=True).stdout

    assert told() == "True 20 25.0 1\n"
    assert len(list(folder.glob("**/*.nbc"))) == 1
    assert told() == "True 20 25.0 2\n"
    for path in package.glob("**/*.nb?"):
        path.unlink()
    assert told() == "True 20 25.0 1\n"  # the index of the folder has one
    assert told() == "True 20 25.0 2\n"


def test_scipys_linear_algebra_is_not_imported_and_can_be(tmp_path):
    """It takes as long as a third of all else before the first block. Whoever multiplies matrices finds it."""
    (tmp_path / "product.py").write_text("import numba\n\n@numba.njit\ndef square(a):\n    return a @ a\n")
    check = (
        "import sys\nimport numpy as np\nfrom server.rendering.convolver import Convolver\n"
        "convolver = Convolver(sources=1, channels=2, block_size=128, ir_samples=1_000)\n"
        "convolver.process(np.zeros((1, 128), np.float32))\n"
        "print('scipy.linalg' in sys.modules)\n"
        "from product import square\nprint(square(np.full((2, 2), 3.0))[0, 0])\n"
        "import scipy.linalg\nprint(scipy.linalg.det(np.eye(2)))"
    )
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(tmp_path), str(Path(server.__file__).parent.parent)])
    }
    output = subprocess.run([sys.executable, "-c", check], env=environment, check=True, capture_output=True, text=True)
    assert output.stdout.split() == ["False", "18.0", "1.0"]


def test_what_works_in_place_changes_what_it_is_given_and_cannot_allocate():
    @compiled_in_place
    def double(values):
        for i in range(values.size):
            values[i] *= 2

    @compiled
    def one_of_copy(values):
        copy = np.empty_like(values)
        copy[:] = values
        return copy[1]

    @compiled_in_place
    def one_of_copy_in_place(values):
        copy = np.empty_like(values)
        copy[:] = values
        return copy[1]

    values = np.arange(5.0)
    double(values[1:4])
    assert values.tolist() == [0, 2, 4, 6, 4]
    assert one_of_copy(values) == 2
    with pytest.raises(NumbaError):
        one_of_copy_in_place(values)


def test_outside_the_server_a_change_in_a_module_beside_is_heeded(package):
    outside = package / "training"
    outside.mkdir()
    (outside / "inner.py").write_text("import numba\n\n\n@numba.njit\ndef twice(x):\n    return 2 * x\n")
    (outside / "outer.py").write_text(
        "from server.kernels.compiled import compiled_loosely\nfrom training.inner import twice\n\n"
        "@compiled_loosely\ndef outer(x):\n    return twice(x) + 1\n"
    )
    check = "from training.outer import outer; print(outer(3), sum(outer.stats.cache_hits.values()))"
    environment = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    environment["PYTHONPATH"] = str(package)

    def told():
        command = [sys.executable, "-c", check]
        return subprocess.run(command, cwd=package, env=environment, check=True, capture_output=True, text=True).stdout

    assert [told(), told()] == ["7 0\n", "7 1\n"]
    inner = outside / "inner.py"
    inner.write_text(inner.read_text().replace("2 * x", "5 * x"))
    assert told() == "16 0\n"


def test_what_a_loosely_compiled_function_calls_keeps_to_the_order_of_sums():
    """Numba passes such a freedom on to what is called, and keeps that for all callers, unless it is told otherwise."""

    @compiled
    def lost(large, small):
        return (large + small) - large

    @compiled_loosely
    def loose(large, small):
        return lost(large, small) + ((large + small) - large)

    @compiled
    def strict(large, small):
        return lost(large, small)

    assert loose(1e16, 0.5) == 0.5
    assert strict(1e16, 0.5) == 0.0
