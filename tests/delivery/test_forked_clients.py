# SPDX-License-Identifier: MIT
"""A process with a client forks: what the parent made is the parent's, however its child ends."""

import os
from pathlib import Path

import pytest
from command_processes import python

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")

FORKS = """
import os, sys
from clients_and_spools import NOBODY, noise
from tsfusion import Client, TransportError
from tsfusion.delivery.spool import Spool
spool = sys.argv[1] or None
client = Client(NOBODY, spool=spool)
client.send(noise(0))
refused = (lambda: client.send(noise(1)), lambda: client.flush(1.0), lambda: client.stats)
for use in (*refused, client.close, lambda: None):
    child = os.fork()
    if not child:
        with client:
            try:
                use()
            except TransportError as error:
                print(error, flush=True)
            sys.exit(7)
    assert os.WEXITSTATUS(os.waitpid(child, 0)[1]) == 7
assert client.send(noise(1)) == 2
assert client.spool_folder.exists()
print(client.stats.sent, client.problem == "" or client.problem)
if spool:
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        os.close(writing)
        os.read(reading, 1)  # lives on until its parent has another client
        os._exit(0)
    client.close()
    with Client(NOBODY, spool=Spool(spool, 1 << 20)) as again:
        print(again.stats.sent, again._outbox.usage()[1])
    os.close(writing)
    os.waitpid(child, 0)
else:
    client.close()
    print(0, 2 * (not client.spool_folder.exists()))
"""


@pytest.mark.parametrize("temporary", [True, False])
def test_a_child_neither_sends_nor_removes_anything(temporary: bool, tmp_path: Path) -> None:
    folder = "" if temporary else str(tmp_path / "spool")
    done = python(FORKS, folder, env={**os.environ, "TMPDIR": str(tmp_path)})
    lines = done.stdout.splitlines()
    refused = "the client belongs to the process that forked this one: make another"
    assert lines[:3] == 3 * [refused], done.stderr
    assert lines[3].startswith("2 ")
    assert lines[4] == "0 2"
    assert not list(tmp_path.glob("tsfusion-spool-*"))


SPOOL = """
import os
from tsfusion.delivery.spool import Spool
spool = Spool(None, 1 << 20)
child = os.fork()
if not child:
    spool.close()
    os._exit(0)
os.waitpid(child, 0)
print(spool.folder.exists())
spool.close()
print(spool.folder.exists())
"""


def test_a_child_removes_no_spool_of_its_parent() -> None:
    assert python(SPOOL).stdout.split() == ["True", "False"]
