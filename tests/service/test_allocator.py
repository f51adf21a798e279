"""A process that answers uses its memory again; in one of its own, as what glibc was told cannot be taken back."""

import platform
import subprocess
import sys

import pytest

MOST_FAULTS = 1000  # of 100 turns; 22,400 where each turn's memory is new
TURNS = """
import resource
from service.allocator import keep_freed_memory

def turns():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(100):
        pieces = [bytearray(2**18) for _ in range(4)]
        del pieces
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

keep_freed_memory()
turns()
print(turns())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries are told nothing")
def test_pieces_of_bodies_take_no_new_memory_once_some_was_freed() -> None:
    done = subprocess.run([sys.executable, "-c", TURNS], capture_output=True, text=True, check=True)
    assert int(done.stdout) < MOST_FAULTS
