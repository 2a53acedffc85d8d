"""Output of C code to the standard streams, caught."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

from kpirl_ocp.c_output import captured

CLOSED = """
import os
from kpirl_ocp.c_output import captured
os.close(2)
with captured(2) as said:
    os.write(2, b"heard")
try:
    os.fstat(2)
except OSError:
    print(said)
"""


def test_what_is_written_in_the_block_is_caught_and_what_follows_is_not(capfd):
    with captured(1, 2) as lines:
        os.write(1, b"to one\nto two\n")
        os.write(2, b"\xff")
        assert lines == []
    os.write(1, b"after")
    assert lines == ["to one", "to two", "\ufffd"]
    assert capfd.readouterr() == ("after", "")


def test_threads_take_turns_and_leave_the_streams_as_they_were(capfd):
    def once(number):
        with captured(2) as lines:
            os.write(2, f"{number}".encode())
        return lines

    with ThreadPoolExecutor(8) as pool:
        assert list(pool.map(once, range(200))) == [[f"{number}"] for number in range(200)]
    os.write(2, b"after")
    assert capfd.readouterr().err == "after"


def test_a_stream_that_is_closed_stays_closed():
    said = subprocess.run([sys.executable, "-c", CLOSED], capture_output=True, text=True, check=True).stdout
    assert said == "['heard']\n"
