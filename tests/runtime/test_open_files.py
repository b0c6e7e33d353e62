"""In processes of their own, whose limits are set before."""

import subprocess
import sys

PROGRAM = """
import resource, sys
resource.setrlimit(resource.RLIMIT_NOFILE, (200, int(sys.argv[1])))
from server.core.errors import NafirError
from server.runtime.open_files import allow_connections
try:
    allow_connections(300)
except NafirError as exc:
    print(exc)
print(resource.getrlimit(resource.RLIMIT_NOFILE)[0])
"""


def said(hard):
    command = [sys.executable, "-c", PROGRAM, str(hard)]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def test_the_process_raises_its_own_limit():
    assert int(said(1000)) >= 300 + 100


def test_where_the_system_allows_fewer_it_says_which_setting_is_too_high():
    message, soft = said(400).splitlines()
    assert "max_connections" in message
    assert "400" in message
    assert int(soft) == 200
